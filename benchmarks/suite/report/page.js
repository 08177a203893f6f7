"use strict";
for (const box of document.querySelectorAll(".compare")) {
  const settings = JSON.parse(box.querySelector("script").textContent);
  const control = role => box.querySelector(`[data-role="${role}"]`);
  const stage = box.querySelector(".stage");
  const range = box.querySelector("input");

  const refill = (select, labels) => {  // keeps the choice where it is still there
    const before = select.value;
    select.replaceChildren(...labels.map(label => new Option(label[1], label[0])));
    if (labels.some(label => String(label[0]) === before)) select.value = before;
  };
  const view = () => settings[control("setting").value].views[control("view").value];

  const split = () => {
    stage.style.setProperty("--split", range.value + "%");
    range.setAttribute("aria-valuetext", range.value + " %");
  };
  const show = () => {
    const shown = view();
    for (const side of ["left", "right"]) {
      const layer = shown.layers.find(layer => layer.label === control(side).value);
      const image = box.querySelector(`[data-side="${side}"]`);
      image.src = layer.path;
      image.alt = `${box.dataset.scene}, ${shown.name}: ${layer.label}`;
      box.querySelector(`.tag.${side}`).textContent = layer.note ? `${layer.label} · ${layer.note}` : layer.label;
    }
    const zoom = control("zoom").value;
    stage.style.aspectRatio = `${shown.width} / ${shown.height}`;
    stage.style.width = zoom === "fit" ? `min(100%, ${80 * shown.width / shown.height}vh)` : shown.width * zoom + "px";
    box.classList.toggle("zoomed", zoom !== "fit");
  };
  const choose = () => {
    refill(control("view"), settings[control("setting").value].views.map((view, index) => [index, view.name]));
    for (const side of ["left", "right"]) refill(control(side), view().layers.map(layer => [layer.label, layer.label]));
    show();
  };
  control("setting").addEventListener("change", choose);
  for (const role of ["view", "left", "right", "zoom"]) control(role).addEventListener("change", show);
  range.addEventListener("input", split);
  choose();
  split();
}
