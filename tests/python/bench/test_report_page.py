"""The report's page: complete without a network, and usable in a browser by mouse and by keyboard, light and dark."""
from __future__ import annotations

import io
import json
import os
import re
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
from report_rows import ALPHA, PROTOCOL, SMOE, TRUTH, failed, row, write_images, write_rows

pytest.importorskip("matplotlib", reason="a report needs matplotlib")
pytest.importorskip("jinja2", reason="a report needs jinja2")
from diff_smoe_rasterization.benchmarks.report import ReportError, report, sliders, survey  # noqa: E402
from diff_smoe_rasterization.trainer.errors import TrainerError  # noqa: E402


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The folder of a report on two settings of one scene with images, and a failed cell."""
    folder = tmp_path_factory.mktemp("results")
    entries = [row(), row(blend_mode="smoe", psnr=22.0), row(threshold=0.0002, psnr=30.0),
               failed("<out of memory> & more", blend_mode="smoe", threshold=0.0002)]
    write_rows(folder, entries)
    write_images(folder, entries[0], ALPHA)
    write_images(folder, entries[1], SMOE)
    write_images(folder, entries[2], TRUTH, names=("three",))
    output = tmp_path_factory.mktemp("report")
    assert report(str(folder), str(output)) == os.path.join(str(output), "index.html")
    return output


class References(HTMLParser):
    """What a page loads."""

    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found += [value for name, value in attrs if name in ("src", "srcset", "href", "poster", "data")]


def test_everything_is_written(written):
    for form in ("md", "csv", "tex"):
        names = {path.stem for path in (written / "tables").glob(f"*.{form}")}
        assert names == {f"table1_{name}" for name in ("table1", "deltas", "cells", "failures")}
    assert {path.name for path in (written / "figures").iterdir()} == {
        f"table1-bonsai-{kind}{end}" for kind in ("rd", "time") for end in (".png", "-light.svg", "-dark.svg")}
    assert (written / "survey" / "table1" / "MipNeRF360" / "bonsai.csv").is_file()


def test_the_page_loads_nothing_but_its_own_files(written):
    text = (written / "index.html").read_text(encoding="utf-8")
    references = References(text).found
    files = [name for name in references if not name.startswith(("#", "data:"))]
    assert files and all((written / name).is_file() for name in files)
    assert not re.search(r"@import|url\(|https?://", re.sub(r"data:[^\"]*", "", text))
    layers = set(re.findall(r'"path": "([^"]+)"', text))
    assert len(layers) == 13  # two views of truth, two renderings, two errors; one view of truth, rendering, error
    assert all((written / name).is_file() for name in layers)


def test_a_second_report_leaves_nothing_of_the_first(written, tmp_path):
    output = tmp_path / "report"
    shutil.copytree(written, output)
    (output / "mine.txt").write_text("kept")
    report(write_rows(tmp_path / "results", [row("fox")]), str(output))
    names = {path.relative_to(output).as_posix() for path in output.rglob("*") if path.is_file()}
    assert {"mine.txt", "index.html", "report.md", "survey/table1/other/fox.csv"} < names
    assert not [name for name in names if "bonsai" in name or "failures" in name or name.startswith("images/")]


def test_a_report_that_fails_leaves_the_earlier_one(written, tmp_path, monkeypatch):
    output = tmp_path / "report"
    shutil.copytree(written, output)

    def files():
        return {path.relative_to(output).as_posix(): path.read_bytes() for path in output.rglob("*") if path.is_file()}

    before = files()
    monkeypatch.setattr(survey, "write_survey", lambda *_: 1 / 0)  # after tables, figures and images
    with pytest.raises(ZeroDivisionError):
        report(write_rows(tmp_path / "results", [row("fox")]), str(output))
    assert files() == before


def test_a_folder_of_others_is_left_alone(tmp_path):
    (tmp_path / "report" / "images").mkdir(parents=True)
    with pytest.raises(ReportError, match="images is of no report"):
        report(write_rows(tmp_path / "results", [row()]), str(tmp_path / "report"))


def test_cells_without_a_row_are_named(tmp_path):
    def counts(rows, **suite):
        folder = tmp_path / "results"
        write_rows(folder, rows)
        (folder / "suite.json").write_text(json.dumps(suite))
        report(str(folder), str(tmp_path / "report"))
        return (tmp_path / "report" / "report.md").read_text(encoding="utf-8").split("\n")[4]

    entries, here = [row(), row(seed=1)], "1 cell on 1 scene, 1 seed; none failed"
    assert counts(entries[:1], name="table1", cells=[entries[0]["cell"], "b"]) == (
        f"{here}; 1 of 2 cells has no row yet: b.")
    assert counts(entries[:1], name="table1", cells=[*"edcba", entries[0]["cell"]]) == (
        f"{here}; 5 of 6 cells have no row yet: a; b; c; 2 more.")
    for suite in ({"name": "other", "cells": ["b"]}, {"name": "table1"}, {"name": "table1", "cells": 3}):
        assert counts(entries[:1], **suite) == f"{here}."
    assert counts(entries, name="table1", cells=[entry["cell"] for entry in entries]) == (
        "2 cells on 1 scene, 2 seeds; none failed.")


def test_files_of_others_are_left_alone(tmp_path):
    (tmp_path / "report" / "images").mkdir(parents=True)
    (tmp_path / "report" / "images" / "mine.png").write_bytes(b"")
    (tmp_path / "report" / "index.html").write_text("my own page")
    with pytest.raises(ReportError, match="index.html is no report"):
        report(write_rows(tmp_path / "results", [row()]), str(tmp_path / "report"))
    assert (tmp_path / "report" / "images" / "mine.png").is_file()


def test_a_report_is_written_into_folders_alone_and_over_links(tmp_path):
    results = write_rows(tmp_path / "results", [row()])
    (tmp_path / "file").touch()
    with pytest.raises(TrainerError, match="file: nothing can be written there .* choose another folder with -o"):
        report(results, str(tmp_path / "file"))
    report(results, str(tmp_path / "report"))
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "mine.txt").touch()
    shutil.rmtree(tmp_path / "report" / "tables")
    (tmp_path / "report" / "tables").symlink_to(tmp_path / "elsewhere")
    report(results, str(tmp_path / "report"))
    assert not (tmp_path / "report" / "tables").is_symlink() and list((tmp_path / "report" / "tables").iterdir())
    assert [path.name for path in (tmp_path / "elsewhere").iterdir()] == ["mine.txt"]


def test_a_page_without_images_says_why(written, tmp_path):
    def page(results):
        report(results, str(tmp_path / "report"))
        return (tmp_path / "report" / "index.html").read_text(encoding="utf-8")

    results = write_rows(tmp_path / "results", [row()])
    assert "No images: rows of another folder." in page(results)
    (tmp_path / "results" / "cells" / row()["cell"]).mkdir(parents=True)
    assert "No images: the suite asked for none." in page(results)
    assert "No images" not in (written / "index.html").read_text(encoding="utf-8")


def test_the_protocol_of_a_scene_is_what_its_cells_share_and_vary(tmp_path):
    said = {**PROTOCOL, "arguments": ["--port", "0"]}
    entries = [row(protocol=said), row(blend_mode="smoe", schedule="steady", protocol=said,
                                       machine={"cells_per_gpu": 3}), failed(seed=1, iterations=7)]
    report(write_rows(tmp_path / "results", entries), str(tmp_path / "report"))
    text = (tmp_path / "report" / "index.html").read_text(encoding="utf-8")
    rules = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", text))
    assert rules["iterations"] == "30000" and rules["schedules"] == "3dgs; steady"
    assert rules["cells that shared their GPU or CPU"] == "1 of 2, up to 3 at once" and "arguments" not in rules


def test_text_of_rows_is_text(written):
    assert "&lt;out of memory&gt; &amp; more" in (written / "index.html").read_text(encoding="utf-8")


def test_renderings_are_copied_byte_for_byte(tmp_path):
    entry = row(blend_mode="smoe", background_gate=0.05)
    write_images(tmp_path / "results", entry, ALPHA, names=("a b",))
    found = sliders.collect(str(tmp_path / "results"), "s u", [entry], str(tmp_path))
    view, = found[0]["settings"][0]["views"]
    truth, gated, error = view["layers"]
    source = tmp_path / "results" / "cells" / entry["cell"] / "images"
    assert (tmp_path / gated["path"]).read_bytes() == (source / "render" / "a b.png").read_bytes()
    assert (tmp_path / truth["path"]).read_bytes() == (source / "gt" / "a b.png").read_bytes()
    assert " " not in truth["path"] + gated["path"] + error["path"]
    # One of three channels is off by 80 of 255: 10 log10(3 (255 / 80)^2)
    assert gated["note"] == error["note"] == "14.84 dB"


def test_errors_take_the_whole_scale():
    def color(difference):
        image = np.full((1, 1, 3), 100, np.uint8)
        image[..., 0] += difference
        return sliders.error_image(np.full((1, 1, 3), 100, np.uint8), image)[0, 0].astype(int)

    # The colour map grows brighter all along; 0.25 of 255, averaged over three channels, is its end.
    brightness = [color(difference).sum() for difference in (0, 40, 80, 120, 155)]
    assert brightness == sorted(set(brightness))
    full = sliders.error_image(np.zeros((1, 1, 3), np.uint8), np.full((1, 1, 3), 64, np.uint8))
    beyond = sliders.error_image(np.zeros((1, 1, 3), np.uint8), np.full((1, 1, 3), 255, np.uint8))
    assert (full == beyond).all() and full.sum() > brightness[-1]


def test_images_under_one_slider_are_of_one_seed(tmp_path):
    entries = [row(seed=0), row(seed=1), row(blend_mode="smoe", seed=1), row(blend_mode="smoe", seed=2)]
    for entry, color in zip(entries, (TRUTH, ALPHA, SMOE, TRUTH)):
        write_images(tmp_path / "results", entry, color, names=("one",))
    found = sliders.collect(str(tmp_path / "results"), "s", entries, str(tmp_path))
    _, alpha, smoe, *_ = found[0]["settings"][0]["views"][0]["layers"]
    assert [Image.open(tmp_path / layer["path"]).getpixel((0, 0)) for layer in (alpha, smoe)] == [ALPHA, SMOE]


@pytest.mark.parametrize("changes", [{"truth": (99, 100, 100)}, {"size": (32, 48)}])
def test_images_of_different_truths_are_refused(tmp_path, changes):
    entries = [row(), row(blend_mode="smoe")]
    write_images(tmp_path, entries[0], ALPHA)
    write_images(tmp_path, entries[1], SMOE, **changes)
    with pytest.raises(ReportError, match="cannot be compared"):
        sliders.collect(str(tmp_path), "table1", entries, str(tmp_path / "report"))


def test_a_report_without_any_success_is_a_report(tmp_path):
    path = report(write_rows(tmp_path / "results", [failed("killed")]), str(tmp_path / "report"))
    with open(path, encoding="utf-8") as file:
        assert "killed" in file.read()


@pytest.fixture(scope="module")
def browser():
    api = pytest.importorskip("playwright.sync_api", reason="the page is tried in a browser by playwright")
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with api.sync_playwright() as playwright:
        try:  # --no-sandbox: for containers, where tests run as root
            started = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        except api.Error as error:
            pytest.skip(f"no Chromium starts here: {str(error).strip().splitlines()[0]}")
        yield started
        started.close()


@pytest.fixture
def page(browser, written, request):
    """The page, opened from its file with the network off; whatever fails in it fails the test."""
    context = browser.new_context(color_scheme=getattr(request, "param", "light"), offline=True,
                                  viewport={"width": 1000, "height": 900})
    opened, complaints = context.new_page(), []
    opened.on("console", lambda message: complaints.append(message.text))
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    opened.on("requestfailed", lambda failure: complaints.append(failure.url))
    opened.goto((written / "index.html").as_uri())
    yield opened
    context.close()
    assert complaints == []


def colors_of(page):
    """The colours (left, right) in the middle row of the stage, at a tenth and nine tenths of its width."""
    stage = page.locator(".stage")
    page.wait_for_function("[...document.querySelectorAll('.stage img')].every(image => image.complete)")
    pixels = np.asarray(Image.open(io.BytesIO(stage.screenshot())).convert("RGB")).astype(int)
    line = pixels[pixels.shape[0] * 3 // 4]
    return tuple(line[len(line) // 10]), tuple(line[len(line) * 9 // 10])


def test_every_image_is_there(page):
    sizes = page.evaluate("[...document.images].map(image => image.complete ? image.naturalWidth : -1)")
    assert len(sizes) == 4 and min(sizes) > 0


def test_the_slider_shows_alpha_to_the_left_and_smoe_to_the_right(page):
    assert colors_of(page) == (ALPHA, SMOE)
    assert page.locator(".tag.left").inner_text().startswith("alpha · 14.84 dB")


def test_the_slider_moves_by_mouse(page):
    box = page.locator(".stage").bounding_box()
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] / 2, middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.02 * box["width"], middle)
    page.mouse.up()
    assert colors_of(page) == (SMOE, SMOE)


def test_everything_is_reached_and_moved_by_keyboard(page):
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.textContent") == "Skip to the results"
    reached = []
    for _ in range(30):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.activeElement.dataset.role || document.activeElement.type || ''"))
        if reached[-1] == "range":
            break
    assert [name for name in reached if name][-6:] == ["setting", "view", "left", "right", "zoom", "range"]
    assert page.locator(".stage").evaluate("element => getComputedStyle(element).outlineStyle") == "solid"
    slider = page.locator(".stage input")
    page.keyboard.press("ArrowRight")
    assert slider.input_value() == "51" and slider.get_attribute("aria-valuetext") == "51 %"
    page.keyboard.press("End")
    assert colors_of(page) == (ALPHA, ALPHA)
    page.keyboard.press("Home")
    assert colors_of(page) == (SMOE, SMOE)


def test_layers_views_and_settings_are_chosen(page):
    page.get_by_label("Left", exact=True).select_option("ground truth")
    assert colors_of(page) == (TRUTH, SMOE)
    page.get_by_label("Right", exact=True).select_option("error of alpha")
    left, right = colors_of(page)
    assert left == TRUTH and right not in (SMOE, ALPHA, TRUTH)
    page.get_by_label("View", exact=True).select_option(label="two")
    assert "bonsai, two: ground truth" == page.locator("[data-side=left]").get_attribute("alt")
    # The other setting has one view and no smoe: the choice that is gone falls back, the other stays.
    page.get_by_label("Setting", exact=True).select_option(label="native, threshold 0.0002")
    assert page.get_by_label("View", exact=True).locator("option").all_inner_texts() == ["three"]
    assert page.get_by_label("Right", exact=True).locator("option").all_inner_texts() == [
        "ground truth", "alpha", "error of alpha"]
    assert page.get_by_label("Left", exact=True).input_value() == "ground truth"
    assert colors_of(page)[0] == TRUTH


def test_a_fitted_image_is_seen_whole(page):
    page.get_by_label("Zoom", exact=True).select_option("3")
    page.get_by_label("Zoom", exact=True).select_option("fit")
    assert page.locator(".stage").bounding_box()["width"] > 800
    page.set_viewport_size({"width": 1000, "height": 300})
    box = page.locator(".stage").bounding_box()
    assert box["height"] == pytest.approx(0.8 * 300, abs=1) and box["width"] == pytest.approx(1.5 * 240, abs=1)


def test_zoom_shows_pixels(page):
    assert page.locator(".stage").bounding_box()["width"] > 48
    page.get_by_label("Zoom", exact=True).select_option("1")
    assert page.locator(".stage").bounding_box()["width"] == 48
    page.get_by_label("Zoom", exact=True).select_option("3")
    assert page.locator(".stage").bounding_box()["height"] == 96


CONTRASTS = """() => {
  const numbers = text => text.match(/[\\d.]+/g).map(Number);
  const luminance = color => { const [r, g, b] = color.slice(0, 3).map(value => value / 255).map(
    value => value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const behind = element => { for (; element; element = element.parentElement) {
    const color = numbers(getComputedStyle(element).backgroundColor);
    if (color.length === 3) return color; } };
  return [...document.querySelectorAll("h1, h2, h3, p, a, td, th, li, dt, dd, label, select, figcaption")].map(
    element => { const [high, low] = [numbers(getComputedStyle(element).color), behind(element)].map(luminance)
      .sort((one, other) => other - one); return [(high + 0.05) / (low + 0.05), element.outerHTML.slice(0, 80)]; });
}"""


@pytest.mark.parametrize("page, dark", [("light", False), ("dark", True)], indirect=["page"])
def test_text_stands_out(page, dark):
    ratios = page.evaluate(CONTRASTS)
    assert len(ratios) > 100 and min(ratios)[0] >= 4.5, min(ratios)  # WCAG 2's least for text, level AA
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (max(map(int, re.findall(r"\d+", background))) < 64) == dark
    sources = page.evaluate("[...document.querySelectorAll('picture img')].map(image => image.currentSrc)")
    assert len(set(sources)) == 2
    light = page.evaluate("[...document.querySelectorAll('picture img')].map(image => image.src)")
    assert (sources == light) != dark


def test_a_narrow_page_does_not_scroll_sideways(page):
    page.set_viewport_size({"width": 360, "height": 700})
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
