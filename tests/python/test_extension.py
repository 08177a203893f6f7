"""The compiled extension: what it says when it cannot be loaded, and what its ops refuse when called directly."""
from __future__ import annotations

import datetime
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest
import torch
from comparison import assert_same_gradients
from devices import random_normal
from PIL import Image
from scenes import op_arguments, op_results, random_scene, with_gate

import diff_smoe_rasterization
from diff_smoe_rasterization import build_info, rasterize, set_profiling, stage_times
from diff_smoe_rasterization.core import _core
from diff_smoe_rasterization.footprints import camera_tensors, image_numbers
from diff_smoe_rasterization.settings import (
    _FIXED_GATES,
    BLEND_MODES,
    CAMERA_MODELS,
    FEATURE_OUTPUTS,
    OUTPUTS,
    ROLLING_SHUTTERS,
    GaussianRasterizationSettings,
    resolve_faint_below,
)

WHERE_THE_PACKAGE_LIES = Path(diff_smoe_rasterization.__file__).parents[1]
DIFFERENTIABLE = ("color", "gate_sum", *FEATURE_OUTPUTS)  # images of the op
on_every_device = pytest.mark.usefixtures("device")


@pytest.fixture
def copied_package(tmp_path, monkeypatch):
    """Returns (folder, import function) of a copy of the package's Python files, without the extension."""
    name = "copy_of_the_package"
    folder = tmp_path / name
    without = shutil.ignore_patterns("_core*", "_ops.so", "_build_info.py", "__pycache__", "csrc", "include")
    shutil.copytree(Path(diff_smoe_rasterization.__file__).parent, folder, ignore=without)
    monkeypatch.syspath_prepend(tmp_path)
    yield folder, lambda submodule="": importlib.import_module(name + submodule)
    for module in [module for module in sys.modules if module.split(".")[0] == name]:
        del sys.modules[module]


def test_a_package_that_was_not_built_says_what_to_type(copied_package):
    package = copied_package[1]()
    for name in ("rasterize", "GaussianRasterizer", "rasterize_gaussians", "build_info", "stage_times",
                 "set_profiling"):
        with pytest.raises(ImportError, match="not built.*pip install"):
            getattr(package, name)
    with pytest.raises(ImportError, match="not built.*pip install"):
        copied_package[1](".io").read_points("points.ply")


def test_settings_and_reference_work_where_nothing_was_built(copied_package):
    package, reference = copied_package[1](), copied_package[1](".reference")
    scene = random_scene("smoe", 5, 20, 18)
    settings = package.GaussianRasterizationSettings(**scene.settings._asdict())
    assert reference.rasterize(settings=settings, **scene.inputs).color.shape == (3, 18, 20)
    assert not hasattr(package, "no_such_name")


LAZY = """
import pickle, sys
import diff_smoe_rasterization as package
assert "torch" not in sys.modules
assert {*package.__all__, "losses", "rasterizer"} <= {*dir(package)}
settings = package.GaussianRasterizationSettings
assert pickle.loads(pickle.dumps(settings)) is settings and "torch" not in sys.modules
assert package.losses.fused_ssim is package.fused_ssim and "torch" in sys.modules
assert pickle.loads(pickle.dumps(package.rasterize)) is package.rasterize
from diff_smoe_rasterization import *
assert SparseGaussianAdam is package.SparseGaussianAdam
"""
EAGER = """
import torch, diff_smoe_rasterization
torch.ops.diff_smoe_rasterization.rasterize
"""


@pytest.mark.parametrize("program", [LAZY, EAGER])
def test_torch_is_loaded_where_it_is_needed_and_its_ops_at_once_where_it_is_there(program):
    path = os.pathsep.join(filter(None, [str(WHERE_THE_PACKAGE_LIES), os.environ.get("PYTHONPATH", "")]))
    subprocess.run([sys.executable, "-c", program], check=True, cwd=os.sep, env={**os.environ, "PYTHONPATH": path})


def test_the_command_says_in_one_line_that_nothing_was_built(copied_package):
    folder, _ = copied_package
    folder.rename(folder.with_name("diff_smoe_rasterization"))
    (folder.parent / "dsmoe").symlink_to(WHERE_THE_PACKAGE_LIES / "dsmoe")

    def run(*words):
        return subprocess.run([sys.executable, "-m", "dsmoe", *words], cwd=str(folder.parent), stdout=subprocess.PIPE,
                              stderr=subprocess.PIPE, universal_newlines=True)

    info = run("info")
    assert info.returncode == 0
    assert re.search("^extension +not usable: .*not built.*pip install.*$", info.stdout, re.MULTILINE)
    (folder.parent / "scene").mkdir()
    (folder.parent / "scene" / "transforms.json").write_text("{}", encoding="utf-8")
    train = run("train", "scene", "-o", "out", "--blend-mode", "smoe")
    assert train.returncode == 1
    assert re.fullmatch("dsmoe train: error: .*not built.*pip install.*\n", train.stderr)
    # What computes nothing works without it.
    checkout = shutil.copytree(Path(__file__).parent / "patches" / "trainer", folder.parent / "trainer")
    for action in ("check", "apply", "revert"):
        patch = run("patch", action, checkout)
        assert patch.returncode == 0, patch.stderr
    (folder.parent / "other" / "gaussian_renderer").mkdir(parents=True)
    (folder.parent / "other" / "gaussian_renderer" / "__init__.py").write_text(
        "from gsplat import rasterization\nrasterization(means=1, rays=None, quality=2)\n")
    assert "gsplat's rasterization with quality, which" in run("patch", "check", folder.parent / "other").stdout
    random = np.random.RandomState(0)
    for index in range(4):
        Image.fromarray(random.randint(0, 255, (60, 80, 3), np.uint8)).save(folder.parent / f"{index}.png")
    scene = run("scene", folder.parent, "-o", folder.parent / "scene")
    reached = "of 4 photographs connect" if importlib.util.find_spec("pycolmap") else r"install pycolmap$"
    assert scene.returncode == 1 and re.search(reached, scene.stderr, re.MULTILINE), scene.stderr


def test_a_build_against_another_torch_names_both_and_says_what_to_type(copied_package):
    folder, load = copied_package
    (folder / "_build_info.py").write_text("TORCH_VERSION = '0.4.1'\n")
    with pytest.raises(ImportError, match=rf"0\.4\.1.*{re.escape(torch.__version__)}.*pip install"):
        load().rasterize


def test_a_build_by_the_stable_abi_refuses_an_older_torch(copied_package):
    folder, load = copied_package
    (folder / "_build_info.py").write_text("TORCH_VERSION = '99.2'\nSTABLE_ABI_SINCE = '99.1'\n")
    with pytest.raises(ImportError, match=rf"works with torch 99\.1 and later.*{re.escape(torch.__version__)}"):
        load().rasterize


def test_an_extension_that_does_not_load_names_the_reason_and_both_versions(copied_package):
    folder, _ = copied_package
    (folder / "_build_info.py").write_text(f"TORCH_VERSION = {torch.__version__!r}\n")
    def of_other_headers(library):
        return re.sub(b"dsmoe_headers_[0-9a-f]{16}", b"dsmoe_headers_" + b"0" * 16, library)

    core = "_core" + sysconfig.get_config_var("EXT_SUFFIX")
    for name, change, words in (
            ("_ops.so", lambda library: b"no library", "ops do not load .*_ops.so.*built against torch"),
            (core, lambda library: b"no library", "_core does not load .*build it again"),
            ("libdsmoe.so", of_other_headers, "_core does not load .*dsmoe_headers_.*build it again")):
        for file in WHERE_THE_PACKAGE_LIES.glob("diff_smoe_rasterization/*.so"):
            shutil.copy(file, folder)
        (folder / name).write_bytes(change((folder / name).read_bytes()))
        run = subprocess.run([sys.executable, "-c", f"import torch, {folder.name}.extension"], cwd=str(folder.parent),
                             stderr=subprocess.PIPE, universal_newlines=True)
        assert run.returncode == 1 and re.search(f"ImportError: .*{words}.*pip install", run.stderr), run.stderr


def test_an_unknown_instruction_set_is_refused_with_those_that_there_are():
    run = subprocess.run([sys.executable, "-m", "dsmoe", "info"], stdout=subprocess.PIPE,
                         universal_newlines=True, env={**os.environ, "DSMOE_SIMD": "mmx"}, cwd=WHERE_THE_PACKAGE_LIES)
    assert run.returncode == 0
    assert re.search('^extension +not usable: .*DSMOE_SIMD is "mmx".*baseline$', run.stdout, re.MULTILINE)


def test_a_plain_import_registers_the_ops():
    code = "import torch, diff_smoe_rasterization; print(torch.ops.diff_smoe_rasterization.rasterize)"
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL, cwd=WHERE_THE_PACKAGE_LIES)


@pytest.mark.skipif(not hasattr(torch.distributed, "DistStoreError"), reason="this PyTorch has no DistStoreError")
def test_errors_of_pytorch_stay_its_own():
    """pybind11 asks translators of all modules that were built by the same version of it."""
    store = torch.distributed.HashStore()
    store.set_timeout(datetime.timedelta(milliseconds=1))
    with pytest.raises(torch.distributed.DistStoreError):
        store.get("absent")
    with pytest.raises(IndexError):
        torch.ops.aten.index.Tensor(torch.zeros(3), [torch.tensor([9])])


def test_build_info_tells_what_runs():
    info = build_info()
    assert info["torch"] == torch.__version__
    assert info["stable_abi_since"] or info["torch_built_with"].split(".")[:2] == torch.__version__.split(".")[:2]
    assert info["version"] == diff_smoe_rasterization.__version__
    assert info["num_threads"] == torch.get_num_threads()
    assert info["simd_level"] in ("avx512", "avx2", "baseline")


def test_the_settings_and_the_op_have_the_same_fields():
    """A setting is a line of csrc/torch/fields.h and a field of this name; these options are not settings."""
    options = set(_core.options) - {"fixed_background_gate", *FEATURE_OUTPUTS, "for_backward", "lens"}
    fields = set(GaussianRasterizationSettings._fields) - {"distortion", "principal_point"}  # which are `lens`
    assert fields - options == {"bg", "viewmatrix", "projmatrix", "campos", "viewmatrix_end",
                                "background_gate"}  # tensors
    assert fields - options <= set(_core.inputs) and options <= fields


def test_the_blend_modes_have_the_numbers_and_the_background_gates_of_the_core():
    modes = diff_smoe_rasterization.core._core.blend_modes
    assert {name: facts["number"] for name, facts in modes.items()} == {mode: i for i, mode in enumerate(BLEND_MODES)}
    assert {name: facts["background_gate"] for name, facts in modes.items()} == _FIXED_GATES
    below = {mode: resolve_faint_below(mode, None) for mode in BLEND_MODES}
    assert {name: round(facts["faint_below"], 6) for name, facts in modes.items()} == below  # a float32


def test_the_camera_models_have_the_numbers_of_the_core():
    assert _core.camera_models == CAMERA_MODELS
    assert _core.rolling_shutters == ROLLING_SHUTTERS


@on_every_device
def test_stage_times_are_taken_while_profiling_is_on():
    scene = random_scene("smoe", 200, 50, 40, dtype=torch.float32).requiring_grad()

    def run():
        rasterize(settings=scene.settings, **scene.inputs).color.sum().backward()
        return stage_times()

    set_profiling(True)
    try:
        first, second = run(), run()
    finally:
        set_profiling(False)
    for name, value in second.items():
        assert value > 0, name
    assert first["forward_pairs"] == second["forward_pairs"]
    assert run() == second


@on_every_device
@with_gate
@pytest.mark.parametrize("outputs", [(), ("alpha", "inverse_depth"), OUTPUTS])
def test_images_may_be_edited_in_place(mode, outputs):
    scene = random_scene(mode, 60, 40, 30, dtype=torch.float32)

    def gradients(edit):
        leaf = scene.requiring_grad()
        rendering = rasterize(settings=leaf.settings, outputs=outputs, **leaf.inputs)
        images = [edit(image) for image in [rendering.color] + [getattr(rendering, name) for name in outputs]]
        sum((image ** 2).sum() for image in images).backward()
        return {name: tensor.grad for name, tensor in leaf.leaves().items()}

    for factor in (0.5, 0.0, -1.0):
        assert_same_gradients(gradients(lambda image: image.mul_(factor)),  # noqa: B023
                              gradients(lambda image: image * factor))  # noqa: B023


@on_every_device
def test_radii_changed_in_place_before_backward_are_noticed(mode):
    """They are not an image, and say which Gaussians have a gradient."""
    scene = random_scene(mode, 60, 40, 30, dtype=torch.float32).requiring_grad()
    rendering = rasterize(settings=scene.settings, **scene.inputs)
    rendering.radii.fill_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        rendering.color.sum().backward()


def backward_arguments(mode, **others):
    """Returns the arguments of the op rasterize_backward by name."""
    scene = random_scene(mode, 20, 20, 18, degree=1, dtype=torch.float32)
    tensors = op_arguments(scene)[:len(_core.inputs)]
    images, saved = op_results(scene)
    present = [tensor is not None for tensor in tensors]
    given = {"dL_d" + name: random_normal(images[name].shape, seed, torch.float32)
             for seed, name in enumerate(DIFFERENTIABLE)}
    given.update(inputs=[tensor for tensor in tensors if tensor is not None], images=list(images.values()),
                 saved=list(saved.values()), present=present, wanted=present)
    schema = torch.ops.diff_smoe_rasterization.rasterize_backward.default._schema
    names = [argument.name for argument in schema.arguments]
    return dict(zip(names, op_arguments(scene, "rasterize_backward", **given, **others)))


def call_backward(arguments):
    return torch.ops.diff_smoe_rasterization.rasterize_backward(*arguments.values())


@on_every_device
@pytest.mark.parametrize("mode", ["smoe", "smoe_std", "smoe_learned_gate"])  # others have the same shapes
@pytest.mark.skipif(not hasattr(torch.library, "opcheck"), reason=f"torch {torch.__version__} has no opcheck")
def test_opcheck_of_rasterize_backward(mode):
    torch.library.opcheck(torch.ops.diff_smoe_rasterization.rasterize_backward.default,
                          tuple(backward_arguments(mode).values()))


@pytest.mark.parametrize("name", [*_core.images, *(name for name, _, _ in _core.saved["cpu"])])
def test_the_backward_op_refuses_results_that_were_cut(name):
    arguments = backward_arguments("smoe")
    results, names = ((arguments["images"], _core.images) if name in _core.images
                      else (arguments["saved"], [name for name, _, _ in _core.saved["cpu"]]))
    index = list(names).index(name)
    results[index] = results[index][:-1]
    with pytest.raises(ValueError, match=rf"rasterize_backward: {name} has "):
        call_backward(arguments)


def test_the_backward_op_refuses_results_of_another_type():
    arguments = backward_arguments("smoe")
    arguments["saved"][0] = arguments["saved"][0].double()
    with pytest.raises(TypeError, match="rasterize_backward: projected .*float32"):
        call_backward(arguments)


@on_every_device
@pytest.mark.parametrize("name", ["inputs", "present", "images", "saved", "wanted"])
def test_the_backward_op_refuses_lists_of_the_wrong_length(name):
    arguments = backward_arguments("smoe")
    arguments[name] = arguments[name][:-1]
    with pytest.raises(ValueError, match=f"rasterize_backward: {name} has length"):
        call_backward(arguments)


@on_every_device
@pytest.mark.parametrize("row, name", [(0, "means3D"), (1, "opacities"), (-4, "bg"), (-3, "viewmatrix"),
                                       (-1, "campos")])
def test_the_backward_op_refuses_absent_inputs(row, name):
    arguments = backward_arguments("smoe")
    inputs, present = list(arguments["inputs"]), list(arguments["present"])
    given = [i for i, here in enumerate(present) if here and i != 1]  # without means2D, which may be absent
    del inputs[1]
    present[1] = present[given[row]] = False
    del inputs[row]
    with pytest.raises(ValueError, match=f"rasterize_backward: {name} is absent"):
        call_backward({**arguments, "inputs": inputs, "present": present})


@on_every_device
def test_the_backward_op_refuses_gradients_of_absent_inputs():
    arguments = backward_arguments("smoe")
    with pytest.raises(ValueError, match="gradient of dc is wanted, but that input is absent"):
        call_backward({**arguments, "wanted": [True] * len(_core.inputs)})


@on_every_device
@pytest.mark.parametrize("op", ["rasterize", "radii"])
def test_the_raw_ops_refuse_colours_without_channels(op):
    """On CUDA nothing would write what the backward pass reads."""
    scene = random_scene("smoe", 20, 20, 18, channels=1, dtype=torch.float32)
    arguments = op_arguments(scene, op, colors_precomp=torch.empty(20, 0), bg=torch.empty(0))
    with pytest.raises(ValueError, match=f"{op}: num_channels is 0; it must be 1 or more"):
        getattr(torch.ops.diff_smoe_rasterization, op)(*arguments)


@on_every_device
@pytest.mark.parametrize("op", ["rasterize", "radii", "project"])
@pytest.mark.parametrize("name", ["means3D", "opacities", "bg", "viewmatrix", "projmatrix", "campos"])
def test_the_raw_ops_refuse_absent_tensors(op, name):
    """PyTorch hands None on where the schema asks for a tensor."""
    scene = random_scene("smoe", 20, 20, 18, dtype=torch.float32)
    arguments = op_arguments(scene, op, **{name: None})
    with pytest.raises(ValueError, match=f"{op}: {name} is absent; it must be given"):
        getattr(torch.ops.diff_smoe_rasterization, op)(*arguments)


def every_call():
    """Returns arguments of every op, by the op's name and the argument's, as the package gives them."""
    scene = random_scene("smoe_learned_gate", 20, 20, 18, degree=1, dtype=torch.float32)
    images, saved = op_results(scene)
    blend = op_arguments(scene, "rasterize")
    gates, features, radii = torch.ops.diff_smoe_rasterization.project(*blend)
    maps = random_normal((18, 20), 1, torch.float32)
    kept = {"radii": images["radii"], "saved": list(saved.values())}
    footprints = {"gates": gates, "features": features, "radii": radii}
    *blended, blend_saved = torch.ops.diff_smoe_rasterization.blend(*op_arguments(scene, "blend", **footprints))
    backward = backward_arguments("smoe_learned_gate")
    image_gradients = {name: value for name, value in backward.items() if name.startswith("dL_d")}
    inputs = {name: backward[name] for name in ("inputs", "present")}
    belongs = [here and name not in ("bg", "background_gate") for name, here in zip(_core.inputs, inputs["present"])]
    cameras = camera_tensors(scene.settings)
    view = {"cameras": cameras, "images": image_numbers(scene.settings), "depth": False, "inverse_depth": False}
    counted = {"radii": torch.zeros(1, 20, dtype=torch.int32), "offsets": torch.tensor([[0, 1]], dtype=torch.int32)}
    wide = torch.zeros(1, 4)
    depth = random_normal((20,), 1, torch.float32)
    raw = [random_normal((20, columns), columns, torch.float32) for columns in (3, 1, 3, 4)]
    values = list(torch.ops.diff_smoe_rasterization.activate(*raw[1:]))

    def alike(tensors=raw):
        return [torch.ones_like(tensor) for tensor in tensors]

    adam = {"moments": alike(), "squares": alike(), "rates": [0.1] * 4, "root_scales": [1.0] * 4, "beta1": 0.9,
            "beta2": 0.999, "epsilon": 1e-8}
    marks, rates = torch.zeros(20, dtype=torch.int32), torch.ones(8, 4, 2)
    image = random_normal((3, 18, 20), 1, torch.float32)
    others = {
        "rasterize": {}, "radii": {}, "project": {}, "blend": footprints, "rasterize_backward": backward,
        "rasterize_backward_seen": {**backward, "gradients": alike(backward["inputs"])},
        "blend_backward": {**image_gradients, "images": blended, "saved": blend_saved, "radii": radii,
                           "wants_background": True},
        "project_backward": {"records": random_normal((20, 6 + features.shape[1]), 1, torch.float32),
                             "dL_ddepths": depth, **inputs, "features": features, "radii": radii, "wanted": belongs},
        "contributions": {"pixel_weights": maps, **kept}, "gate_map": {"gate_sum": images["gate_sum"], **kept},
        "importance": {"pixel_weights": maps, "share_weights": maps, "color": images["color"],
                       "gate_sum": images["gate_sum"], **kept},
        "count_rows": view, "project_rows": {**view, **counted, "gates": [gates[:1]], "features": [wide]},
        "project_rows_backward": {**view, **counted, "features": [wide], "records": [wide.new_zeros(1, 9)]},
        "mark_visible": {"positions": scene.inputs["means3D"]},
        "adam": {"parameters": alike(), "gradients": alike(), **adam, "visible": torch.ones(20, dtype=torch.bool)},
        "lazy_adam_catch_up": {"parameters": alike(), "gradients": alike(), **adam, "marks": marks, "rates": rates,
                               "steps": 1, "radii": radii},
        "lazy_adam_step": {"marks": marks, "rates": rates, "steps": 1, "new_rates": [0.1] * 4,
                           "root_scales": [1.0] * 4, "radii": radii},
        "gaussian_adam": {"raw": alike(), "values": alike(raw[1:]), "dL_dvalues": alike(), **adam, "radii": radii},
        "gather_rows": {"tensors": raw, "rows": torch.arange(3)},
        "image_loss": {"image": image, "target": image, "l1_weight": 0.8, "l2_weight": 0.0, "ssim_weight": -0.2,
                       "offset": 0.2, "margin": 0, "with_gradient": True},
        "activate": dict(zip(("opacities", "scales", "rotations"), raw[1:])),
        "activate_backward": {"raw": raw[1:], "values": values,
                              **dict(zip(("dL_dopacities", "dL_dscales", "dL_drotations"), alike(raw[1:])))},
        "gate_adam": {**dict(zip(("logarithm", "moment", "square", "gate", "gradient"), alike([torch.ones(1)] * 5))),
                      "rate": 0.03, "root_scale": 1.0, "beta1": 0.9, "beta2": 0.999, "epsilon": 1e-8, "bound": 0.0,
                      "limit": 60.0},
        "set_inputs": {"to": alike(), "source": alike(), "numbers": torch.zeros(2), "new_numbers": [1.0, 2.0]},
        "add_view": {"dL_dmeans2D": raw[0], "radii": radii, "gradient_sum": depth, "view_count": depth.clone()},
        "pixel_reach": {"radii": radii, "opacities": depth, "squared_reaches": depth},
        "mean_squared_neighbour_distances": {"points": raw[0]}}
    calls = {}
    for op, given in others.items():
        names = [each.name for each in getattr(torch.ops.diff_smoe_rasterization, op).default._schema.arguments]
        calls[op] = dict(zip(names, op_arguments(scene, op, **given)))
    return calls


def names_of_ops():
    library = "diff_smoe_rasterization::"
    return sorted(schema.name[len(library):] for schema in torch._C._jit_get_all_schemas()
                  if schema.name.startswith(library))


@on_every_device
@pytest.mark.parametrize("op", names_of_ops())
def test_every_op_refuses_tensors_of_several_devices(op, device):
    """Each tensor in turn lies elsewhere; so does each of a list. By its like on `meta` torch calls the fake op.

    The device's own op is then called all the same: on a GPU torch calls it if one of the others is on the CPU.
    """
    function, arguments = getattr(torch.ops.diff_smoe_rasterization, op), every_call()[op]
    function(*arguments.values())
    moved = 0
    own = torch._C.DispatchKeySet(getattr(torch._C.DispatchKey, device.type.upper()))
    for name, value in arguments.items():
        tensors = value if isinstance(value, list) else [value]
        for index, tensor in enumerate(tensors):
            if not isinstance(tensor, torch.Tensor):
                continue
            for other in {"meta", "cpu"} - {device.type}:
                changed = tensors[:index] + [tensor.to(other)] + tensors[index + 1:]
                given = {**arguments, name: changed if isinstance(value, list) else changed[0]}
                if sum(isinstance(each, torch.Tensor) for item in given.values()
                       for each in (item if isinstance(item, list) else [item])) == 1:
                    continue  # it is the only one
                with pytest.raises((TypeError, NotImplementedError), match=rf"{op}|markVisible|meta|Meta"):
                    function(*given.values())
                if other == "meta":
                    with pytest.raises(TypeError, match=rf"({op}|markVisible): .* is on .*; it must be on .*, as "):
                        function.default.redispatch(own, *given.values())
                moved += 1
    assert moved > 0 or op == "mean_squared_neighbour_distances"


def moved_by_one(value):
    """Returns the tensors of an argument at places that are multiples of one number, and of no vector."""
    if isinstance(value, list):
        return [moved_by_one(each) for each in value]
    if not isinstance(value, torch.Tensor) or not value.is_contiguous():
        return value
    memory = value.new_empty(value.numel() + 1)[1:]
    return memory.copy_(value.reshape(-1)).view(value.shape)


def as_double(value):
    if isinstance(value, list):
        return [as_double(each) for each in value]
    return value.double() if isinstance(value, torch.Tensor) and value.dtype == torch.float32 else value


def flat(values):
    """Returns the tensors among results or arguments, lists of tensors too."""
    for value in values if isinstance(values, (tuple, list)) else [values]:
        yield from flat(value) if isinstance(value, (tuple, list)) else [value] * isinstance(value, torch.Tensor)


def written(op, results):
    """Returns what an op writes of its results: some have rows that mean nothing."""
    if op in ("rasterize", "blend"):
        return results[:-1]
    if op == "project":
        return [each[results[2] > 0] for each in results]
    return results[1:] if op == "project_rows_backward" else results


@on_every_device
@pytest.mark.parametrize("op", names_of_ops())
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_op_takes_tensors_wherever_they_lie(op, dtype, device):
    """As a hook of `saved_tensors_hooks`, or a slice, hands them over: a kernel loads vectors where they begin."""
    if dtype == torch.float64 and op.endswith(("_rows", "rows_backward")) and op != "gather_rows":
        pytest.skip("of float32 alone")
    function, arguments = getattr(torch.ops.diff_smoe_rasterization, op), every_call()[op]
    if dtype == torch.float64:
        arguments = {name: as_double(value) for name, value in arguments.items()}
    # Of one call: rows of culled Gaussians in saved tensors hold whatever was in the memory.
    moved = {name: moved_by_one(value) for name, value in arguments.items()}
    calls = [arguments, moved]
    results = [function(*calls[0].values())]
    try:
        results.append(function(*calls[1].values()))
    except ValueError as error:  # what is written where it lies cannot be copied
        assert op in ("gaussian_adam", "project_rows", "project_rows_backward") and "must begin at a" in str(error)
        return
    results = [written(op, each) for each in results]
    for one, other in zip(flat([*results[:1], *calls[0].values()]), flat([*results[1:], *calls[1].values()])):
        if device.type == "cpu" or not one.is_floating_point():
            assert torch.equal(one.nan_to_num(), other.nan_to_num())
        else:  # sums are added in any order
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5, equal_nan=True)


@on_every_device
@with_gate
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_saved_tensors_may_come_back_at_another_place(mode, dtype):
    scene = random_scene(mode, 20, 20, 18, degree=1, dtype=dtype).requiring_grad()

    def gradients():
        images = rasterize(settings=scene.settings, outputs=OUTPUTS, **scene.inputs)
        leaves = scene.leaves()
        return dict(zip(leaves, torch.autograd.grad(images.color.square().sum() + images.depth.sum(),
                                                    list(leaves.values()))))

    expected = gradients()
    with torch.autograd.graph.saved_tensors_hooks(moved_by_one, lambda tensor: tensor):
        assert_same_gradients(gradients(), expected, 1e-5)


@on_every_device
@pytest.mark.parametrize("name, wrong, message", [
    ("tanfovx", 0.0, r"tan_fov_x \(tanfovx\) is 0; it must be positive and finite"),
    *((side, size, f"image_width x image_height is {size if side == 'image_width' else 20} x "
                   f"{18 if side == 'image_width' else size}; both must be 1 to 4194240")
      for side in ("image_width", "image_height") for size in (-20, 4194241, 1 << 31)),
    ("fixed_background_gate", 2e30, r"background_gate is 2e\+30; it must be 0 to 1e\+30")])
def test_the_raw_op_refuses_values(name, wrong, message):
    scene = random_scene("smoe", 20, 20, 18, dtype=torch.float32)
    with pytest.raises(ValueError, match=f"rasterize: {message}"):
        torch.ops.diff_smoe_rasterization.rasterize(*op_arguments(scene, **{name: wrong}))


@on_every_device
@pytest.mark.parametrize("field", ["bg", "viewmatrix", "projmatrix", "campos"])
def test_debug_names_the_camera_tensor_that_holds_nan(field):
    scene = random_scene("smoe", 20, 20, 18, dtype=torch.float32)
    broken = getattr(scene.settings, field).clone()
    broken.view(-1)[1] = float("nan")
    settings = scene.settings._replace(debug=True, **{field: broken})
    with pytest.raises(RuntimeError, match=rf"rasterize: {field}\[.*1\] is NaN"):
        rasterize(settings=settings, **scene.inputs)


@on_every_device
def test_debug_names_the_image_gradient_that_holds_nan():
    scene = random_scene("smoe", 20, 20, 18, dtype=torch.float32).with_settings(debug=True).requiring_grad()
    color = rasterize(settings=scene.settings, **scene.inputs).color
    gradient = torch.ones_like(color)
    gradient[2, 3, 4] = float("nan")
    with pytest.raises(RuntimeError, match=r"rasterize_backward: dL_dcolor\[2, 3, 4\] is NaN"):
        color.backward(gradient)


class OnGpu(torch.Tensor):
    """A tensor that says so, as where torch has CUDA and this build has no kernels."""

    @property
    def device(self):
        return torch.device("cuda:0")


def on_gpu(*shape):
    return torch.zeros(*shape).as_subclass(OnGpu)


@pytest.mark.parametrize("name, call", [
    ("rasterize", lambda package: package.rasterize(on_gpu(4, 3), on_gpu(4), random_scene("alpha", 4, 8, 8).settings)),
    ("markVisible", lambda package: package.GaussianRasterizer(random_scene("alpha", 4, 8, 8).settings).markVisible(
        on_gpu(4, 3))),
    ("distCUDA2", lambda package: package.distCUDA2(on_gpu(4, 3))),
    ("fused_ssim", lambda package: package.fused_ssim(on_gpu(1, 3, 8, 8), on_gpu(1, 3, 8, 8))),
    ("SparseGaussianAdam.step", lambda package: package.SparseGaussianAdam(
        [torch.nn.Parameter(torch.zeros(4, 3))], lr=0.1, eps=1e-8).step(on_gpu(4).bool().as_subclass(OnGpu), 4))])
def test_a_build_without_kernels_says_why_where_it_is_given_a_tensor_on_a_gpu(name, call, monkeypatch):
    """Whichever function a trainer calls first: pip hides what the build said."""
    for module in ("extension", "arguments"):
        monkeypatch.setattr(importlib.import_module(f"diff_smoe_rasterization.{module}"), "BACKENDS", ("cpu",))
    monkeypatch.setattr(importlib.import_module("diff_smoe_rasterization.checks"), "has_kernels", lambda: False)
    monkeypatch.setattr(importlib.import_module("diff_smoe_rasterization.extension"), "build_info",
                        lambda: {"without_cuda_because": "no GPU was seen"})
    with pytest.raises(TypeError, match=rf"^{name}: \w+ is on cuda:0; this build renders on cpu: no GPU was seen$"):
        call(importlib.import_module("diff_smoe_rasterization"))
