"""Measures one renderer in a process of its own; gpu_rasterizer.py starts it with a request and reads its rows."""
from __future__ import annotations

import json
import math
import os
import sys
import time
import traceback
from statistics import fmean, median
from typing import Any, Callable, Dict, List

import gpu_floor
import models
import torch
from gpu_renderers import Ours, Renderer, renderer_named

DEVICE = "cuda"
MEBIBYTE = 2 ** 20
WALL_REPEATS = 20
STAGE_REPEATS = 5


def event_milliseconds(call: Callable[[], Any], warmup: int, repeats: int) -> float:
    """The median time between CUDA events around the call; the host runs ahead, as in a training loop."""
    for _ in range(warmup):
        call()
    torch.cuda.synchronize()
    events = [(torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)) for _ in range(repeats)]
    for start, end in events:
        start.record()
        call()
        end.record()
    torch.cuda.synchronize()
    return median(start.elapsed_time(end) for start, end in events)


def wall_milliseconds(call: Callable[[], Any], repeats: int) -> float:
    """The median time on the host's clock from an idle GPU to an idle GPU."""
    times = []
    for _ in range(repeats):
        torch.cuda.synchronize()
        start = time.perf_counter()
        call()
        torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - start))
    return median(times)


def wake_the_clocks() -> None:
    matrix = torch.randn(4096, 4096, device=DEVICE)
    for _ in range(40):
        matrix = (matrix @ matrix).clamp(-1, 1)
    torch.cuda.synchronize()


def psnr(image: torch.Tensor, expected: torch.Tensor) -> float:
    """Of images clamped to [0, 1]; 99 dB stands for equal ones."""
    error = (image.clamp(0, 1).double() - expected.clamp(0, 1).double()).pow(2).mean().item()
    return min(99.0, -10 * math.log10(error)) if error > 0 else 99.0


def cosine(a: torch.Tensor, b: torch.Tensor) -> float:
    a, b = a.double().flatten(), b.double().flatten()
    return (a @ b / (a.norm() * b.norm())).item()


class Measurement:
    """One renderer over all views."""

    def __init__(self, renderer: Renderer, dL_dimage: torch.Tensor):
        self.renderer = renderer
        self.dL_doutput = renderer.output_gradient(dL_dimage)

    def forward(self, view):
        with torch.no_grad():
            return self.renderer.render(view)

    def forward_and_backward(self, view) -> List[torch.Tensor]:
        return self.renderer.gradients(self.renderer.render(view), self.dL_doutput)

    def times(self, warmup: int, repeats: int) -> Dict[str, float]:
        """Means over views of medians, in milliseconds."""
        calls = {"forward": self.forward}
        if self.renderer.has_backward:
            calls["total"] = self.forward_and_backward
        result = {}
        for name, call in calls.items():
            result[name + "_ms"] = fmean(event_milliseconds(lambda v=view, c=call: c(v), warmup, repeats)
                                         for view in self.renderer.views)
            result[name + "_wall_ms"] = fmean(wall_milliseconds(lambda v=view, c=call: c(v), WALL_REPEATS)
                                              for view in self.renderer.views)
        return result

    def peak_mib(self) -> float:
        """What torch's allocator holds at most beyond parameters and gradients, of the worst view, in MiB."""
        def start():
            torch.cuda.synchronize()
            torch.cuda.reset_peak_memory_stats()

        def beyond(kept=0):
            torch.cuda.synchronize()
            return torch.cuda.max_memory_allocated() - before - kept

        worst = 0
        for view in self.renderer.views:
            start()
            before = torch.cuda.memory_allocated()
            if not self.renderer.has_backward:
                self.forward(view)
                worst = max(worst, beyond())
                continue
            output = self.renderer.render(view)
            worst = max(worst, beyond())
            start()
            gradients = self.renderer.gradients(output, self.dL_doutput)
            worst = max(worst, beyond(sum(tensor.numel() * tensor.element_size() for tensor in gradients)))
            del output, gradients
        return worst / MEBIBYTE

    def images(self) -> torch.Tensor:
        """[views, 3, H, W], on the CPU."""
        return torch.stack([self.renderer.image(self.forward(view)).float().cpu() for view in self.renderer.views])

    def means_gradient(self) -> torch.Tensor:
        """[N, 3] of the first view, on the CPU."""
        index = list(self.renderer.parameters).index("means3D")
        return self.forward_and_backward(self.renderer.views[0])[index].cpu()


def compare(measurement: Measurement, folder: str) -> Dict[str, float]:
    """Compares with the renderer that was first to call this, and so left its results in the folder."""
    path = os.path.join(folder, "reference.pt")
    images = measurement.images()
    means_gradient = measurement.means_gradient() if measurement.renderer.has_backward else None
    if not os.path.exists(path):
        torch.save((images, means_gradient), path)
        return {}
    expected_images, expected_gradient = torch.load(path)
    values = [psnr(image, expected) for image, expected in zip(images, expected_images)]
    row = {"psnr": fmean(values), "psnr_worst": min(values)}
    if means_gradient is not None:
        row["cosine"] = cosine(means_gradient, expected_gradient)
    return row


def num_instances(renderer: Ours, settings) -> int:
    """(Gaussian, tile) pairs of a rendering: where the last tile's list ends."""
    from diff_smoe_rasterization import extension, rasterize_with_splats
    with torch.no_grad():
        _, splats = rasterize_with_splats(settings=settings, **renderer.parameters)
    names = [name for name, *_ in extension._core.saved["cuda"]]
    return int(splats._saved[names.index("tile_offsets")][-1])


def stages(measurement: Measurement) -> Dict[str, Any]:
    """Our own stages in milliseconds, what they had to do, and their floors."""
    from diff_smoe_rasterization import rasterize, set_profiling, stage_times
    renderer, samples, views = measurement.renderer, [], measurement.renderer.views
    set_profiling(True)
    for view in views:
        runs = []
        for _ in range(STAGE_REPEATS):
            measurement.forward_and_backward(view)
            torch.cuda.synchronize()
            runs.append(stage_times())
        samples.append({name: median(run[name] for run in runs) for name in runs[0]})
    set_profiling(False)
    times = {name: fmean(sample[name] for sample in samples) for name in samples[0]}
    with torch.no_grad():
        visible = fmean(int((rasterize(settings=view, **renderer.parameters).radii > 0).sum()) for view in views)
    counts = gpu_floor.Counts(
        gaussians=len(renderer.parameters["means3D"]), visible=visible,
        instances=fmean(num_instances(renderer, view) for view in views),
        pixels=views[0].image_width * views[0].image_height, forward_pairs=times["forward_pairs"],
        backward_pairs=times["backward_pairs"],
        parameter_bytes=sum(tensor[0].numel() * tensor.element_size() for tensor in renderer.parameters.values()))
    floors = gpu_floor.floors(views[0].blend_mode, counts)
    return {"counts": counts._asdict(),
            "stages": {name: {"ms": 1e3 * times[name], "floor_ms": 1e3 * floor.seconds,
                              "bytes_ms": 1e3 * floor.bytes, "instructions_ms": 1e3 * floor.instructions}
                       for name, floor in floors.items()}}


def measure(request: Dict[str, Any], row: Dict[str, Any]) -> None:
    """Fills the row; what was measured before an error stays in it."""
    renderer_type = renderer_named(request["renderer"])
    row["note"] = renderer_type.note
    if renderer_type.folder:
        sys.path.insert(0, os.path.join(request["peers_path"], renderer_type.folder))
    wake_the_clocks()
    model = models.from_npz(request["model"]).seen(request["views"], request["width"], request["height"]).to(DEVICE)
    camera = model.cameras[0]
    row.update(gaussians=model.num_gaussians, width=camera.width, height=camera.height, views=len(model.cameras))
    renderer = renderer_type(model)
    del model
    generator = torch.Generator(device="cpu").manual_seed(0)
    shape = (3, camera.height, camera.width)
    dL_dimage = torch.randn(shape, generator=generator).to(DEVICE) / math.prod(shape)
    torch.cuda.empty_cache()
    outside = torch.cuda.mem_get_info()[0] + torch.cuda.memory_reserved()
    measurement = Measurement(renderer, dL_dimage)
    if renderer.is_alpha:
        row.update(compare(measurement, request["folder"]))
    row.update(measurement.times(request["warmup"], request["repeats"]))
    row["peak_mib"] = measurement.peak_mib()
    row["outside_torch_mib"] = (outside - torch.cuda.mem_get_info()[0] - torch.cuda.memory_reserved()) / MEBIBYTE
    if isinstance(renderer, Ours):
        row.update(stages(measurement))


def main(path: str) -> int:
    """path: a JSON file that holds the request; the row is written beside it."""
    with open(path, encoding="utf-8") as file:
        request = json.load(file)
    row: Dict[str, Any] = {"renderer": request["renderer"]}
    try:
        measure(request, row)
    except Exception as error:  # of a peer: told in the table
        row["error"] = f"{type(error).__name__}: {error}".splitlines()[0][:300]
        traceback.print_exc()
    with open(path + ".row", "w", encoding="utf-8") as file:
        json.dump(row, file)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
