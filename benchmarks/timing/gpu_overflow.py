"""Times a frame whose tile lists do not fit their memory beside the same frame with room, and counts such frames.

    python benchmarks/timing/gpu_overflow.py --synthetic 5500000
    python benchmarks/timing/gpu_overflow.py --ply MODEL.ply --scene SCENE --blend smoe:0.03
    python benchmarks/timing/gpu_overflow.py --train SCENE -o OUT --device cuda ...    # the words of `dsmoe train`

The frame is one captured graph. Captured while no Gaussian is visible, it has room for 65,536 instances; all Gaussians
come back before it is replayed. The count of a training includes its evaluations.
"""
from __future__ import annotations

import argparse
import sys
from typing import Any, Callable, Dict, List

import models
import torch
from gpu_renderers import Ours, ours
from gpu_worker import event_milliseconds, num_instances, wake_the_clocks

from diff_smoe_rasterization import autograd, direct, extension
from dsmoe.cli import main as dsmoe

LEARNED = 70  # calls after which room is what was seen, and an eighth more
LEAST_INSTANCES = 2 * 65_536  # more than there is room for if nothing is visible


def graph_of(call: Callable[[], Any]) -> torch.cuda.CUDAGraph:
    """A graph of the call, after calls from which the room for its lists is learned."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(LEARNED):
            call()
    torch.cuda.current_stream().wait_stream(stream)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        call()
    return graph


def time_frames(renderer: Ours, view, repeats: int) -> Dict[str, float]:
    """Milliseconds of forward and of forward plus backward, by whether the lists fit."""
    means = renderer.parameters["means3D"]
    places = means.detach().clone()
    times = {}
    for backward in (False, True):
        for fits in (False, True):
            view = view._replace(image_height=view.image_height - 1)  # a size that no rendering has had
            frame = frame_of(renderer, view, backward)
            if not fits:
                with torch.no_grad():
                    means.copy_(view.campos.expand_as(means))  # culled, as they are nearer than the near plane
            graph = graph_of(frame)
            with torch.no_grad():
                means.copy_(places)
            name = f"{'forward + backward' if backward else 'forward'}, {'room' if fits else 'no room'}"
            times[name] = event_milliseconds(graph.replay, 1, repeats)
            del graph
    return times


def frame_of(renderer: Ours, view, backward: bool) -> Callable[[], Any]:
    dL_dimage = torch.randn(3, view.image_height, view.image_width, device="cuda")

    def forward():
        with torch.no_grad():
            return renderer.render(view)

    def both():
        return renderer.gradients(renderer.render(view), dL_dimage)

    return both if backward else forward


class CountedRasterize:
    """The op `rasterize`, which notes for each call on CUDA how many instances its lists had no room for."""

    def __init__(self, op: Any, missing: List[torch.Tensor]) -> None:
        self._op, self._missing = op, missing
        names = [name for name, *_ in extension._core.saved["cuda"]]
        self._offsets, self._instances = names.index("tile_offsets"), names.index("instances")

    def __call__(self, *arguments: Any) -> Any:
        result = self._op(*arguments)
        saved = result[-1]
        room = saved[self._instances].numel()
        if room > 0:  # else the lists are made in bands
            self._missing.append((saved[self._offsets][-1] - room).clamp(min=0))
        return result

    default = __call__


class CountedOps:
    """The ops; calls of `rasterize` are counted."""

    def __init__(self, missing: List[torch.Tensor]) -> None:
        self._ops = torch.ops.diff_smoe_rasterization
        self.rasterize = CountedRasterize(self._ops.rasterize, missing)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._ops, name)


def count_in_training(words: List[str]) -> int:
    missing: List[torch.Tensor] = []
    autograd._OPS = direct._OPS = CountedOps(missing)
    status = dsmoe(["train", *words])
    without_room = torch.stack(missing).nonzero().squeeze(1).tolist() if missing else []
    print(f"{len(missing)} renderings; the lists of {len(without_room)} did not fit their memory: "
          f"{', '.join(map(str, without_room)) or 'none'}")
    return status


def main(arguments=None) -> int:
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["--train"]:
        return count_in_training(arguments[1:])
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--npz", help="packed model with its cameras, as gpu_rasterizer.py --save-npz writes it")
    parser.add_argument("--ply", help="trained model instead; with --scene")
    parser.add_argument("--scene", help="its scene folder, whose first test view is rendered")
    parser.add_argument("--resolution", type=int, default=1, help="as in `dsmoe train`")
    parser.add_argument("--synthetic", type=int, metavar="N", help="N made-up Gaussians instead")
    parser.add_argument("--blend", default="smoe:0.03", help="the mode, with its gate")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(arguments)
    if sum(value is not None for value in (options.npz, options.ply, options.synthetic)) != 1:
        parser.error("give one of --npz, --ply and --synthetic")
    model = (models.from_npz(options.npz) if options.npz
             else models.from_files(options.ply, options.scene, options.resolution) if options.ply
             else models.synthetic(options.synthetic))
    renderer = ours("ours " + options.blend)(model.seen(1).to("cuda"))
    view = renderer.views[0]
    instances = num_instances(renderer, view)
    if instances < LEAST_INSTANCES:
        parser.error(f"the view has {instances} tile instances, which always fit; it must have {LEAST_INSTANCES}")
    wake_the_clocks()
    print(f"{torch.cuda.get_device_name()}: {model.num_gaussians:,} Gaussians, {options.blend}, "
          f"{view.image_width}x{view.image_height}, {instances:,} instances, medians of {options.repeats}")
    for name, milliseconds in time_frames(renderer, view, options.repeats).items():
        print(f"{name}: {milliseconds:.3f} ms")
    return 0


if __name__ == "__main__":
    sys.exit(main())
