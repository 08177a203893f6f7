"""Runs a script of a public trainer and writes down what it does, without changing a file of it.

    python observer.py RECORD.json --seed N --iterations N [--renders FOLDER] ... -- SCRIPT ARGUMENT...

It runs in the trainer's own Python and imports nothing of this project. It relies on what the trainers have in common:
they seed with constants, show their loop as a tqdm bar over the iterations, and render by
`gaussian_renderer.render(view, model, ...)["render"]` (HAC after `prefilter_voxel`) or `model.render(view)["render"]`.

RECORD.json: loop_seconds, peak_gpu_mib, num_gaussians, background_gate, views [{name, milliseconds, file, truth}]. The
files of the renderings are arrays [3, H, W] of float32, unclamped, in FOLDER. The gate is a learned one, as it is when
the script ends; null if nothing was rendered with such a gate.
"""
import argparse
import importlib.abc
import importlib.machinery
import json
import os
import random
import runpy
import sys
import time
import types

WARM_UPS = 2


def main():
    words = sys.argv[1:]
    split = words.index("--")
    parser = argparse.ArgumentParser()
    parser.add_argument("record")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--iterations", type=int, required=True)
    parser.add_argument("--renders")
    parser.add_argument("--stub", default="")
    parser.add_argument("--no-pictures", action="store_true")
    parser.add_argument("--hold-out", action="store_true")
    parser.add_argument("--model-renders", metavar="ATTRIBUTE")
    options = parser.parse_args(words[:split])
    script, arguments = words[split + 1], words[split + 2:]
    sys.argv = [script, *arguments]
    sys.path[0] = os.path.dirname(os.path.abspath(script))
    import torch

    for name in filter(None, options.stub.split(",")):  # after torch, as the trainers import them
        without_lpips() if name == "lpips" else stub(name)
    if options.no_pictures:  # what is rendered is kept as floats, and torchvision may be absent
        stub("torchvision")
        import torchvision.utils

        torchvision.utils.save_image = lambda *arguments, **keywords: None
    shift_seeds(options.seed)
    views = watch_renderings(options.renders) if options.renders and not options.model_renders else {}
    scenes = watch_scenes(options.hold_out) if options.model_renders else []
    bar = watch_loop(options.iterations, views)
    try:
        runpy.run_path(script, run_name="__main__")
        if options.model_renders:
            views.update(renderings_of(scenes[-1], options.model_renders, options.renders))
    finally:
        peak = torch.cuda.max_memory_allocated() / 2 ** 20 if torch.cuda.is_available() else None
        with open(options.record, "w") as file:
            json.dump({"loop_seconds": bar.get("seconds"), "peak_gpu_mib": bar.get("peak", peak),
                       "num_gaussians": views.pop("num_gaussians", None), "background_gate": learned_gate(),
                       "views": list(views.values())}, file)


def learned_gate():
    module = sys.modules.get("diff_smoe_rasterization.learned_gate")
    return module.gate.value() if module and module.gate.blend_mode and module.gate.is_known else None


def synchronise():
    import torch

    if torch.cuda.is_available():
        torch.cuda.synchronize()


def shift_seeds(seed):
    """Adds this one to every seed that the script sets: the trainers fix theirs to 0."""
    import numpy
    import torch

    def shifted(original):
        return lambda value, *rest: original(int(value) + seed, *rest)

    for module, name in ((random, "seed"), (numpy.random, "seed"), (torch, "manual_seed")):
        setattr(module, name, shifted(getattr(module, name)))


def watch_loop(iterations, views):
    """Times the bar over so many iterations; returns where that goes."""
    import torch
    import tqdm

    found = {}

    class Bar(tqdm.tqdm):
        def __init__(self, *arguments, **keywords):
            super().__init__(*arguments, **keywords)
            words = getattr(self, "desc", "")  # a bar that is disabled has none
            if words.startswith("Rendering progress"):  # the final one; HAC renders training views on the way
                views.clear()
            self.counted = self.total == iterations
            self.trains = self.counted or words.startswith("Training progress")
            if self.counted and torch.cuda.is_available():
                torch.cuda.reset_peak_memory_stats()
            synchronise()
            self.began = time.perf_counter()

        def close(self):
            if getattr(self, "counted", False) and "seconds" not in found:
                synchronise()
                found["seconds"] = time.perf_counter() - self.began
            if getattr(self, "trains", False) and "peak" not in found and torch.cuda.is_available():
                found["peak"] = torch.cuda.max_memory_allocated() / 2 ** 20
            super().close()

    tqdm.tqdm = Bar
    return found


def timed(function, *arguments, **keywords):
    synchronise()
    began = time.perf_counter()
    result = function(*arguments, **keywords)
    synchronise()
    return result, time.perf_counter() - began


def keep(folder, number, view, image, seconds):
    import numpy

    os.makedirs(folder, exist_ok=True)
    files = {kind: os.path.join(folder, f"{kind}_{number}.npy") for kind in ("file", "truth")}
    for path, kept in zip(files.values(), (image, view.original_image[:3])):
        numpy.save(path, kept.detach().float().cpu().numpy())
    return {"name": view.image_name, "milliseconds": 1000 * seconds, **files}


def watch_scenes(hold_out):
    """Keeps every scene.Scene that is made; with hold_out the split is made as `--eval` makes it.

    Only that: Deformable Beta Splatting then also chooses its model and its last iteration on the test views.
    """
    import scene

    made, original = [], scene.Scene.__init__

    def init(self, args, *arguments, **keywords):
        before = args.eval
        args.eval = before or hold_out
        try:
            original(self, args, *arguments, **keywords)
        finally:
            args.eval = before
        made.append(self)

    scene.Scene.__init__ = init
    return made


def renderings_of(scene, attribute, folder):
    import torch

    model, views, found = getattr(scene, attribute), scene.getTestCameras(), {}
    with torch.no_grad():
        for view in views[:WARM_UPS]:
            model.render(view)
        for number, view in enumerate(views):
            result, seconds = timed(model.render, view)
            found[view.image_name] = keep(folder, number, view, result["render"], seconds)
    found["num_gaussians"] = len(model.get_xyz)
    return found


def watch_renderings(folder):
    """Times and keeps what is rendered without gradients, the last rendering of each view; returns where that goes."""
    import gaussian_renderer
    import torch

    found, pending, numbers = {}, {"seconds": 0.0, "warm": False}, {}
    render = gaussian_renderer.render

    def watched(view, model, *arguments, **keywords):
        if torch.is_grad_enabled():
            return render(view, model, *arguments, **keywords)
        for _ in range(0 if pending["warm"] else WARM_UPS):
            render(view, model, *arguments, **keywords)
        pending["warm"] = True
        result, seconds = timed(render, view, model, *arguments, **keywords)
        number = numbers.setdefault(view.image_name, len(numbers))
        found[view.image_name] = keep(folder, number, view, result["render"], seconds + pending["seconds"])
        pending["seconds"] = 0.0
        found["num_gaussians"] = len(model.get_anchor if hasattr(model, "get_anchor") else model.get_xyz)
        return result

    gaussian_renderer.render = watched
    if hasattr(gaussian_renderer, "prefilter_voxel"):
        prefilter = gaussian_renderer.prefilter_voxel

        def prefiltered(*arguments, **keywords):
            if torch.is_grad_enabled():
                return prefilter(*arguments, **keywords)
            if not pending["warm"]:
                prefilter(*arguments, **keywords)
            result, pending["seconds"] = timed(prefilter, *arguments, **keywords)
            return result

        gaussian_renderer.prefilter_voxel = prefiltered
    return found


class Absent(types.ModuleType):
    """Stands for a module that is imported and not used; anything may be asked of it, nothing called."""

    __path__ = []

    def __mro_entries__(self, bases):
        return (object,)  # so that a class may be derived from it

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return Absent(self.__name__ + "." + name)


class AbsentFinder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def __init__(self, name):
        self.name = name

    def find_spec(self, fullname, path=None, target=None):
        ours = fullname.partition(".")[0] == self.name
        return importlib.machinery.ModuleSpec(fullname, self, is_package=True) if ours else None

    def create_module(self, spec):
        return Absent(spec.name)

    def exec_module(self, module):
        pass


def without_lpips():
    """A trainer's own LPIPS is NaN, so that nothing is downloaded: the renderings are measured elsewhere."""
    import torch

    nan = torch.nn.Module()
    nan.forward = lambda image, *others, **keywords: torch.full((1, 1, 1, 1), float("nan"), device=image.device)
    for name in ("lpips", "lpipsPyTorch"):
        sys.modules[name] = types.SimpleNamespace(LPIPS=lambda *words, **keywords: nan, lpips=nan)


def stub(name):
    """Lets a module be imported that this Python lacks, or has and cannot import: turtle without tkinter is one."""
    try:
        importlib.import_module(name)
    except (Exception, SystemExit):  # of whatever kind: the module is not needed
        for loaded in [loaded for loaded in sys.modules if loaded.partition(".")[0] == name]:
            del sys.modules[loaded]
        sys.meta_path.insert(0, AbsentFinder(name))  # before the finder of the one that cannot be imported


if __name__ == "__main__":
    main()
