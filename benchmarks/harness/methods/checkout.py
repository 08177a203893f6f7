"""Public trainers' checkouts as methods: one class for each shape of commands.

Each command runs in the checkout's folder and Python, observed by observer.py. Renderings come back as floats and are
measured here, against this project's own ground truth. A checkout that renders other views, or was trained on other
images, is refused.
"""
from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, Dict, List, Optional, Tuple, Type

import numpy as np
import torch

from diff_smoe_rasterization.settings import (
    BACKGROUND_GATE_VARIABLE,
    BLEND_MODE_VARIABLE,
    FAINT_BELOW_VARIABLE,
    GATED_MODES,
)

from ...options.config import LEARNED, TrainConfig
from ...patches.runtime import STAND_INS
from ...results.evaluation import Evaluation, summary
from ...results.pictures import evenly_spaced
from ...scenes.images import View
from ...scenes.scene import Scene
from ...system.children import die_with_parent
from ..errors import BenchError, last_line
from ..measure import Measures
from ..names import COUNTED_BY, RECIPE, read_json
from ..protocol import commit_of, config_of
from .outcome import Outcome, scene_of

OBSERVER = os.path.join(os.path.dirname(os.path.abspath(__file__)), "observer.py")
# Mean difference between the trainer's ground truth and ours: rounding leaves half a grey level at the most, another
# downscaler or background leaves several.
MAX_TRUTH_DIFFERENCE = 1 / 255


class ThreeDGS:
    """train.py -s SCENE -m MODEL, then render.py -m MODEL: 3DGS of 2023 and of 2024."""

    stubs: Tuple[str, ...] = ("torchvision",)  # modules that are imported for what is not done here
    observed: Tuple[str, ...] = ()  # further arguments of the observer
    render_arguments: Tuple[str, ...] = ()
    container = "point_cloud.ply"
    of_gaussians = True  # as in 3DGS, with SH colours
    trains_with_arguments = True  # the method's arguments go to train.py

    def __init__(self, cell: Dict[str, Any], config: TrainConfig, output: str) -> None:
        self.cell, self.config, self.output = cell, config, os.path.abspath(output)
        self.method = cell["method"]
        self.model = os.path.join(self.output, "run")
        self.renders = os.path.join(self.output, "renders")
        self.scene = os.path.join(self.output, "scene")
        self.arguments: List[str] = []  # of the commands that made the model

    def train(self) -> Dict[str, Any]:
        """This and `render` return the observer's record."""
        return self.command("train", self.method["path"], "train.py", *self.train_arguments())

    def render(self) -> Dict[str, Any]:
        return self.command("render", self.method["path"], "render.py", "-m", self.model, "--skip_train", "--quiet",
                            *self.render_arguments, renders=self.renders, observed=("--no-pictures",))

    def train_arguments(self) -> List[str]:
        config = self.config
        words = ["-s", self.scene, "-m", self.model, *self.test_arguments(), "--iterations", config.iterations,
                 "--save_iterations", config.iterations, "--port", 0]  # a free one: cells run side by side
        if self.method["name"] not in COUNTED_BY:
            words += ["--densify_grad_threshold", config.densify_grad_threshold]
        words += ["-r", config.resolution] if config.resolution != -1 else []
        words += ["--images", config.images] if config.images != "images" else []
        words += ["--white_background"] if config.white_background else []
        words += self.recipe_arguments()
        if self.method["variant"] != "unpatched":
            words += ["--blend_mode", config.blend_mode]
            words += ["--background_gate", config.background_gate] if config.blend_mode in GATED_MODES else []
        return [str(word) for word in words] + (self.method["arguments"] if self.trains_with_arguments else [])

    def test_arguments(self) -> List[Any]:
        return ["--eval", "--test_iterations", -1]

    def recipe_arguments(self) -> List[str]:
        """What the suite says of the recipe, default of ours or not; what it does not say is the trainer's own."""
        options = self.recipe()
        options.pop("sh_degree_interval", None)
        if self.config.strategy == "steady":
            # Size prune and reset both wait for the interval: beyond the last iteration there is neither.
            options["opacity_reset_interval"] = self.config.iterations + 1
        flags = ["--antialiasing"] if options.pop("antialiasing", False) else []
        return flags + [str(word) for name, value in options.items() for word in ("--" + name, value)]

    def recipe(self) -> Dict[str, Any]:
        options = self.cell["protocol"]["options"]
        return {name: getattr(self.config, name) for name in RECIPE if name in options}

    def rules(self) -> Dict[str, Any]:
        """What the row's protocol says otherwise than of the native trainer; None if there is no such thing."""
        own = {word.partition("=")[0] for word in self.method["arguments"]}
        recipe = {name: value for name, value in self.recipe().items() if "--" + name not in own}
        rules = {"strategy": self.cell["strategy"], "recipe": recipe, "scale_recipe": False,
                 "arguments": portable(self.arguments)}
        if not self.of_gaussians:
            rules["sh_degree"] = recipe.get("sh_degree")
        if self.method["name"] in COUNTED_BY:
            rules["densify_grad_threshold"] = None
        if "base" in self.method:
            rules["base_commit"] = self.method.get("base_commit") or commit_of(self.method["base"])
        return rules

    def own_bytes(self) -> int:
        return size_of(os.path.join(self.model, "point_cloud", f"iteration_{self.config.iterations}", self.container))

    def train_seconds(self, trained: Dict[str, Any]) -> Optional[float]:
        return trained["loop_seconds"]

    def command(self, name: str, folder: str, script: str, *words: str, renders: Optional[str] = None,
                observed: Tuple[str, ...] = ()) -> Dict[str, Any]:
        """Runs a script in the checkout; returns the observer's record. Raises BenchError with how it ended."""
        record = os.path.join(self.output, name + ".json")
        line = [self.method["python"] or sys.executable, OBSERVER, record, "--seed", str(self.config.seed),
                "--iterations", str(self.config.iterations), "--stub", ",".join(self.stubs), *self.observed,
                *observed]
        line += (["--renders", renders] if renders else []) + ["--", os.path.join(folder, script), *words]
        if not os.path.isfile(os.path.join(folder, script)):
            raise BenchError(f"{folder}: there is no {script} in it; {self.method['name']} is run by it")
        log = os.path.join(self.output, name + ".log")
        if name != "render":
            self.arguments += words
        with open(log, "w", encoding="utf-8") as file:
            status = subprocess.call(line, cwd=folder, stdout=file, stderr=subprocess.STDOUT,
                                     stdin=subprocess.DEVNULL, env=self.environment(), preexec_fn=die_with_parent)
        if status != 0:
            raise BenchError(f"{script} of {self.method['label']} ended with status {status}: "
                             f"{last_line(log) or 'it printed nothing'} (all of it is in {os.path.basename(log)})")
        return read_json(record)

    def environment(self) -> Dict[str, str]:
        ours = os.environ.get("PYTHONPATH", "").split(os.pathsep)
        # The observer imports the trainer's modules before the script has called modernise.start().
        stand_ins = [str(STAND_INS)] * (self.method["variant"] != "unpatched")
        path = [item for item in [*self.method["pythonpath"], *ours, *stand_ins] if item]
        environment = {name: value for name, value in os.environ.items()
                       if name not in (BLEND_MODE_VARIABLE, BACKGROUND_GATE_VARIABLE, FAINT_BELOW_VARIABLE,
                                       "PYTHONSAFEPATH")}
        if self.config.unusual_faint is not None:
            environment[FAINT_BELOW_VARIABLE] = str(self.config.unusual_faint)
        return {**environment, "PYTHONPATH": os.pathsep.join(path), "PYTHONDONTWRITEBYTECODE": "1"}


class Taming(ThreeDGS):
    stubs = ()  # it finds edges with torchvision while it trains


class TwoDGS(ThreeDGS):
    stubs = (*ThreeDGS.stubs, "open3d", "trimesh", "mediapy")  # for meshes, which are not extracted
    render_arguments = ("--skip_mesh",)


class C3DGS(ThreeDGS):
    """Compressed 3DGS: a 3DGS checkout (`base`) trains, compress.py compresses and finetunes, render.py renders."""

    stubs = ("lpips",)  # compress.py measures it, with weights that it would download
    container = "point_cloud.npz"
    trains_with_arguments = False  # they go to compress.py

    def train(self) -> Dict[str, Any]:
        self.model = os.path.join(self.output, "run", "base")
        trained = self.command("train", self.method["base"], "train.py", *self.train_arguments())
        compressed = os.path.join(self.output, "run", "compressed")
        # --iterations 0: no bar is the one that is timed, as a peak would begin with it, and leave earlier stages out.
        finished = self.command("compress", self.method["path"], "compress.py", "--model_path", self.model,
                                "--output_vq", compressed, "--load_iteration", str(self.config.iterations),
                                *self.recipe_arguments(), *self.method["arguments"], observed=("--iterations", "0"))
        self.model = compressed
        peaks = [record["peak_gpu_mib"] for record in (trained, finished)]
        return {**trained, "peak_gpu_mib": None if None in peaks else max(peaks)}

    def train_seconds(self, trained: Dict[str, Any]) -> Optional[float]:
        path = os.path.join(self.model, "times.json")
        if trained["loop_seconds"] is None or not os.path.isfile(path):
            return None
        return trained["loop_seconds"] + read_json(path)["total"]

    def own_bytes(self) -> int:
        folder = os.path.join(self.model, "point_cloud")
        return sum(size_of(os.path.join(folder, name, self.container)) for name in os.listdir(folder))


class Compact3DGS(ThreeDGS):
    """Compact-3DGS (Lee et al. 2024): the model is quantised, and its colours are those of a hash grid."""

    container = "point_cloud_pp.npz"
    of_gaussians = False

    def train_arguments(self) -> List[str]:
        return [*super().train_arguments(), "--comp", "--store_npz"]


class InOneProcess(ThreeDGS):
    """Only train.py: it also renders the test views, or the observer does when it is done."""

    def train(self) -> Dict[str, Any]:
        return self.command("train", self.method["path"], "train.py", *self.train_arguments(), renders=self.renders)

    def render(self) -> Dict[str, Any]:
        return read_json(os.path.join(self.output, "train.json"))


class HAC(InOneProcess):
    """HAC and HAC++: train.py trains, encodes, decodes and renders in one process."""

    stubs = ("wandb", "lpips")  # it reads its pictures again with torchvision, at the end
    of_gaussians = False  # anchors, from which networks make Gaussians

    def test_arguments(self) -> List[Any]:
        return ["--eval", "--test_iterations", self.config.iterations]  # the last test encodes the model

    def own_bytes(self) -> int:
        return size_of(os.path.join(self.model, "bitstreams"))


class DBS(InOneProcess):
    """Deformable Beta Splatting: only train.py; the number of primitives is given (`--cap_max`), no threshold.

    Its own `--eval` keeps the model that is best on the test views. Here they are held out, and that is all.
    """

    # Of its viewer, of its compression, and one that its rasterizer imports and does not use.
    stubs = (*ThreeDGS.stubs, "viser", "nerfview", "plas", "turtle")
    observed = ("--hold-out", "--model-renders", "beta_model")
    of_gaussians = False  # Beta primitives, with lobes of its own beside SH

    def test_arguments(self) -> List[Any]:
        return []  # the observer holds views out

    def train_arguments(self) -> List[str]:
        return [*super().train_arguments(), "--disable_viewer", "--no-compress"]


SHAPES: Dict[str, Type[ThreeDGS]] = {"3dgs-2023": ThreeDGS, "3dgs-2024": ThreeDGS, "taming": Taming, "2dgs": TwoDGS,
                                     "dbs": DBS, "c3dgs": C3DGS, "compact-3dgs": Compact3DGS, "hac": HAC,
                                     "hac-plus": HAC}


def run_checkout(cell: Dict[str, Any], output: str) -> Outcome:
    if cell["method"].get("refused"):
        raise BenchError(cell["method"]["refused"])
    config = config_of(cell, output)
    scene = scene_of(config)
    shape = SHAPES[cell["method"]["name"]](cell, config, output)
    for left in (shape.model, shape.renders, shape.scene):  # of an earlier attempt; these trainers do not continue one
        shutil.rmtree(left, ignore_errors=True)
    linked_scene(config.scene, shape.scene)
    try:
        trained = shape.train()
        rendered = shape.render()
        pairs = matched(scene, rendered["views"], shape.method["label"])
        measures = Measures(config.device, cell["protocol"]["lpips"])
        difference, evaluation = measured(pairs, measures, config.device)
        kept = [pairs[index] for index in evenly_spaced(len(pairs), cell["images"])]
        renders = {view.camera.name: torch.from_numpy(np.load(seen["file"])) for view, seen in kept}
    finally:
        shutil.rmtree(shape.renders, ignore_errors=True)
        if not cell["keep_models"]:  # a model that is kept names its scene, as the path that was trained on
            shutil.rmtree(shape.scene, ignore_errors=True)
    return Outcome(scene=scene, evaluation=evaluation, lpips=measures.lpips_of(evaluation.metrics),
                   num_gaussians=rendered["num_gaussians"], own_bytes=shape.own_bytes(),
                   train_seconds=shape.train_seconds(trained), peak_gpu_mib=trained["peak_gpu_mib"],
                   are_gaussians=shape.of_gaussians,
                   commit=shape.method.get("commit") or commit_of(shape.method["path"]), renders=renders,
                   notes={"ground_truth_difference": difference, **shape.rules(),
                          **({"background_gate": rendered["background_gate"]} if config.background_gate == LEARNED
                             else {})})


def portable(words: List[str]) -> List[str]:
    """The words of a command without the folders in which things lie here: /a/b and --data=/a/b are b, --data=b."""
    shown = []
    for word in words:
        option, equals, value = ("", "", word) if os.path.isabs(word) else word.partition("=")
        shown.append(option + equals + (os.path.basename(os.path.normpath(value)) if os.path.isabs(value) else value))
    return shown


def linked_scene(source: str, folder: str) -> None:
    """Makes a folder that holds a scene. Trainers write point clouds beside what they read, or over it: these are
    copied, all else is linked."""
    os.makedirs(folder)
    for name in os.listdir(source):
        path, link = os.path.abspath(os.path.join(source, name)), os.path.join(folder, name)
        if os.path.isdir(path) and name in ("sparse", "0"):
            linked_scene(path, link)
        elif os.path.isfile(path) and name.endswith(".ply"):
            shutil.copyfile(path, link)
        else:
            os.symlink(path, link)


def matched(scene: Scene, seen: List[Dict[str, Any]], label: str) -> List[Tuple[View, Dict[str, Any]]]:
    """Our test views with the trainer's renderings. Raises BenchError if the split is not the same."""
    by_name = {Path(row["name"]).stem: row for row in seen}  # trainers keep folder and extension, or drop them
    expected = {Path(view.camera.name).stem for view in scene.test}
    wrong = sorted(expected ^ set(by_name))
    if wrong:
        raise BenchError(f"{label} rendered {len(by_name)} test views, the split has {len(expected)} "
                         f"({', '.join(wrong[:3])}, ... are only in one of them): another split gives other figures")
    return [(view, by_name[Path(view.camera.name).stem]) for view in scene.test]


def measured(pairs: List[Tuple[View, Dict[str, Any]]], measures: Measures, device: str) -> Tuple[float, Evaluation]:
    """The largest mean difference between both ground truths, and the figures. Raises BenchError beyond the limit."""
    per_view, largest = [], 0.0
    for view, seen in pairs:
        truth, theirs = view.image_float(), torch.from_numpy(np.load(seen["truth"]))
        if theirs.shape != truth.shape:
            raise BenchError(f"{view.camera.name}: the trainer's image is {tuple(theirs.shape)}, the protocol's "
                             f"{tuple(truth.shape)}: another resolution gives other figures")
        largest = max(largest, float((theirs - truth).abs().mean()))
        color = torch.from_numpy(np.load(seen["file"])).to(device)
        per_view.append({"name": view.camera.name, "milliseconds": seen["milliseconds"],
                         **measures(color, truth.to(device))})
    if largest > MAX_TRUTH_DIFFERENCE:
        raise BenchError(f"the trainer's ground truth differs from the protocol's by {255 * largest:.2f} grey levels "
                         "on average: another downscaler or background gives other figures")
    return largest, summary(per_view)


def size_of(path: str) -> int:
    """Bytes of a file, or of all files in a folder. Raises BenchError if it is absent."""
    if not os.path.exists(path):
        raise BenchError(f"{path}: no such file; the trainer left no model there")
    return sum(file.stat().st_size for file in [Path(path), *Path(path).rglob("*")] if file.is_file())
