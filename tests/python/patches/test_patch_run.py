"""`dsmoe run`: what the command's processes see, what is refused, and the exit status."""
from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys

import pytest
from checkouts import GR, PACKAGE_PARENT, RENDERER, contents, environment, make, refused
from packaged import ROOT, packages_and_data

from diff_smoe_rasterization.integrations.contracts import CONTRACTS, NAMES
from diff_smoe_rasterization.settings import BLEND_MODES, GATED_MODES
from dsmoe import patches
from dsmoe.patches import run

SHOW = """import os, sys
sys.path.insert(0, "")
from diff_gaussian_rasterization import GaussianRasterizer
print(GaussianRasterizer.__module__, os.environ["DSMOE_BLEND_MODE"], sys.argv[1:])
import gaussian_renderer
sys.exit(7)
"""
RUN = ("run", "--blend-mode", "smoe")
WORDS = ["--blend_mode", "a b", "--", "*", "--help", ""]


def test_an_unmodified_checkout_runs_and_stays_as_it_was(tmp_path, python):
    """The script's folder says which trainer it is; a child of the child has the same rasterizer and mode."""
    checkout = make(tmp_path / "a trainer", {
        "show.py": SHOW, "parent.py": "import os, subprocess, sys\nos.chdir(os.path.dirname(sys.argv[0]))\n"
                                      "sys.exit(subprocess.call([sys.executable, 'show.py'] + sys.argv[1:]))\n"})
    before = contents(tmp_path)
    result = python("-m", "dsmoe", *RUN, "--background-gate", "0.25", "--", sys.executable,
                    checkout / "parent.py", *WORDS, cwd=tmp_path, PYTHONPATH=str(PACKAGE_PARENT))
    assert result.status == 7, result.err
    assert result.out.splitlines() == [f"diff_smoe_rasterization.integrations.inria smoe {WORDS}"]
    announced, *said = result.err.splitlines()
    words = "of this package, blend mode smoe, background gate 0.25"
    assert "3dgs-2023" in announced and "will be inria " + words in announced
    assert said == ["diff_smoe_rasterization: the rasterizer is inria " + words]
    assert contents(tmp_path) == before


ENDS = {  # what a command does, and how `dsmoe run` ends then
    "made(None)": (0, ""), "pass": (1, "rendered nothing: what was trained or rendered was not smoe"),
    "import os, signal; os.kill(os.getpid(), signal.SIGKILL)": (137, ""),
    "import numpy\nfrom PIL import Image\nmade(None)\n"  # as 3DGS loads Blender's scenes: new releases refuse both
    "assert Image.fromarray(numpy.full((1, 1, 3), numpy.int(-1), numpy.byte)).getpixel((0, 0)) == (255,) * 3": (0, ""),
    "import contextlib, diff_gaussian_rasterization as d\nwith contextlib.suppress(TypeError): d.rasterize_gaussians()":
        (0, "")}


@pytest.mark.parametrize("code", ENDS)
def test_it_ends_as_the_command_unless_nothing_was_rendered(code, tmp_path, python):
    script = f"import sys\nfrom diff_gaussian_rasterization import GaussianRasterizer as made\n{code}\n"
    make(tmp_path, {"x.py": script})
    result = python("-m", "dsmoe", *RUN, "--", sys.executable, "x.py", cwd=tmp_path)
    status, said = ENDS[code]
    assert result.status == status and said in result.err, result.err


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process of its parent's end")
def test_the_command_ends_where_dsmoe_run_is_killed(tmp_path):
    make(tmp_path, {"x.py": "import signal, sys, time\n"
                            "signal.signal(signal.SIGTERM, lambda *_: sys.exit(print('told to end', flush=True)))\n"
                            "print('ready', flush=True)\ntime.sleep(60)\n"})
    words = [sys.executable, "-m", "dsmoe", *RUN, "--", sys.executable, "x.py"]
    with subprocess.Popen(words, cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.kill()
        assert process.stdout.read() == "told to end\n", "read to its end, at which the command has ended"


@pytest.mark.parametrize("renders", [False, True])
def test_that_nothing_was_rendered_is_said_at_the_first_step(renders, tmp_path, python):
    """Not only at the end: gsplat's own function, taken from where no rasterizer of this package is put."""
    call = "import torch, gsplat\nfrom gsplat import rasterization\n"
    script = call + ("gsplat.rasterization and None\n" if not renders else CALL_GSPLAT) + (
        "w = torch.ones(1, requires_grad=True)\nw.sum().backward()\nadam = torch.optim.Adam([w])\n"
        "adam.step()\nadam.step()\nprint('trained')\n")
    make(tmp_path, {GR: None, "x.py": script})
    result = python("-m", "dsmoe", *RUN, "--", sys.executable, "x.py", cwd=tmp_path,
                    PYTHONPATH=str(PACKAGE_PARENT))
    assert result.out.endswith("trained\n") and result.status == (0 if renders else 1), result.err
    assert result.err.count("the first step of an optimizer, and this rasterizer has rendered nothing") == (not renders)


@pytest.mark.parametrize("number, ignored", [(signal.SIGTERM, False), (signal.SIGUSR1, False), (signal.SIGHUP, True)])
def test_a_signal_reaches_the_command(number, ignored, tmp_path):
    """It was sent to `dsmoe run` only. What is ignored, as under nohup, stays so. Ctrl-C is the command's affair."""
    make(tmp_path, {"x.py": "import signal, time\n"
                            f"ignored = signal.getsignal({int(number)}) == signal.SIG_IGN\n"
                            f"signal.signal({int(number)}, lambda *_: exit(5))\n"
                            "print(ignored, flush=True)\ntime.sleep(0.5 if ignored else 60)\nexit(6)\n"})
    process = subprocess.Popen([sys.executable, "-m", "dsmoe", *RUN, "--", sys.executable, "x.py"],
                               cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                               preexec_fn=lambda: ignored and signal.signal(number, signal.SIG_IGN))
    assert process.stdout.readline().decode() == f"{ignored}\n"
    for sent in (signal.SIGINT, number):
        process.send_signal(sent)
    assert process.wait(30) == (6 if ignored else 5)
    process.stdout.close()


def test_stand_ins_only_for_what_is_missing(tmp_path, python):
    """What the command's Python can import itself is left to it. Each stand-in says that it is used."""
    code = ("from simple_knn._C import distCUDA2; import fused_ssim; "
            "from weighted_distance._C import weightedDistance; "
            "print(distCUDA2.__module__, fused_ssim.fused_ssim.__module__)")
    variables = environment()["PYTHONPATH"]  # has simple_knn and fused_ssim, and no weighted_distance
    result = python("-c", code, cwd=tmp_path, PYTHONPATH=os.pathsep.join([str(run.STAND_INS), variables]))
    assert result.status == 0 and result.out == "simple_knn._C fused_ssim\n"
    assert [line.split()[1] for line in result.err.splitlines()] == ["weighted_distance"], result.err
    broken = tmp_path / "broken/fused_ssim"
    broken.mkdir(parents=True)
    (broken / "__init__.py").write_text("raise OSError('undefined symbol')\n")
    result = python("-c", "import fused_ssim; print(fused_ssim.fused_ssim.__module__)", cwd=tmp_path,
                    PYTHONPATH=os.pathsep.join([str(run.STAND_INS), str(broken.parent), str(PACKAGE_PARENT)]))
    assert result.out == "diff_smoe_rasterization.losses\n" and "own takes its place" in result.err


@pytest.mark.parametrize("mode", BLEND_MODES)
def test_the_gate_of_the_children(mode, monkeypatch, dsmoe):
    """That which is asked for, else the variable's, else the mode's; and none in modes that know none."""
    words = [sys.executable, "-c", "a.py"]
    own = "learned" if mode == "smoe" else 0.0
    for variable, asked, gate in (("", None, own), ("0.25", None, 0.25), ("0.25", 0.0, 0.0),
                                 ("0.25", "learned", "learned")):
        monkeypatch.setenv("DSMOE_BACKGROUND_GATE", variable)
        if mode in GATED_MODES or asked is None:
            made, lines = run.prepare(words, mode, "scaffold", dict(os.environ), asked)
            assert made["DSMOE_BACKGROUND_GATE"] == (str(gate) if mode in GATED_MODES else "")
            assert (f"blend mode {mode}, background gate {gate};" in lines[0]) == (mode in GATED_MODES)
    for gate in ("-1", "nan") if mode in GATED_MODES else ("0.1",):
        said = dsmoe("run", "--blend-mode", mode, "--background-gate", gate, "--trainer", "scaffold", "--", *words)
        assert said.status == 1 and "background_gate is" in said.err


OURS = RENDERER.replace("diff_gaussian_rasterization import", "diff_smoe_rasterization.integrations.inria import")
GOF = RENDERER.replace("diff_gaussian_rasterization", "diff_gaussian_rasterization_gof")
MASKS = "gaussian_renderer/masks.py"
PYTHON = [*RUN, "--", sys.executable, "train.py"]
AS_INRIA = [*RUN, "--trainer", "inria", "--", sys.executable, "train.py"]


@pytest.mark.parametrize("words, missing", [
    ("python train.py", "train.py"), ("python3.12 -u -O train.py a.py", "train.py"), ("python", ""), ("python -i", ""),
    ("python - a.py", ""), ("python -cpass a.py", ""), ("python -c pass a.py", ""), ("python -mtimeit a.py", ""),
    ("torchrun train.py", "")])
def test_a_missing_script_is_one_that_python_would_open(words, missing, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run._missing_script(words.split()) == missing


@pytest.mark.parametrize("files, words, said", [
    ({}, ["run", "--", "python", "train.py"], "--blend-mode"), ({}, ["run", "--blend-mode", "smooth"], "smoe_tn"),
    ({}, [*RUN, "--"], "there is no command"), ({}, ["run", "--blend_mode", "smoe", "--"], "there is no command"),
    ({}, [*RUN, "--", "no-such-command"], "no-such-command: No such file"),
    ({"tool.py": ""}, [*RUN, "--", "./tool.py"], "./tool.py: Permission denied"),
    ({GR: None}, PYTHON, f"--trainer list` prints the names):\n  there is no {GR} in"),
    ({}, ["run", "--blend-mode", "paper", "--", "x"], "for the paper's program type --paper"),
    ({}, ["train", "x", "-o", "o", "--blend-mode", "paper"], "for the paper's program type --paper"),
    ({GR: None}, ["run", "--paper", "--", sys.executable, "-u", "trian.py"], "trian.py: there is no such script in"),
    ({GR: None, "x/" + GR: ""}, [*RUN, "--", sys.executable], "in x: change into that folder"),
    ({}, [*RUN, "--trainer", "nerf", "--", sys.executable], "there is no trainer 'nerf'; it must be one of 3d-smoe"),
    ({"diff_gaussian_rasterization.py": ""}, PYTHON, "diff_gaussian_rasterization.py would be imported before"),
    ({"diff_gaussian_rasterization/a": ""}, PYTHON, "diff_gaussian_rasterization would be imported before"),
    ({GR: OURS}, PYTHON, "is patched already: run the command itself, with --blend_mode"),
    # Under --trainer too: gaussian-opacity-fields, and a renderer of no rasterizer at all.
    ({GR: GOF}, PYTHON, "it imports diff_gaussian_rasterization_gof, another rasterizer"),
    ({GR: RENDERER + GOF}, AS_INRIA, "it imports diff_gaussian_rasterization_gof, another"),
    # DepthAwareGS, whose rasterizer has more than images: without it the training would stop when it first asks.
    ({GR: RENDERER + "rasterizer.to(0), rasterizer.apply_weights(1)\n"}, PYTHON, "has a method apply_weights, which"),
    # A second renderer beside the first, by which masks are trained.
    ({MASKS: GOF, "train.py": "from gaussian_renderer.masks import render\n"}, PYTHON, "_gof, another rasterizer"),
    ({MASKS: GOF, GR: "from . import masks\n" + RENDERER}, PYTHON, "_gof, another rasterizer"),
    ({GR: RENDERER.replace("debug=", "require_depth=True, debug=")}, PYTHON, "have require_depth, as RaDe-GS's"),
    ({GR: "from nvdiffrast import rasterize\n"}, AS_INRIA, "nothing imports GaussianRasterizationSettings from")])
def test_what_would_not_use_the_rasterizer_is_refused(files, words, said, tmp_path, dsmoe, monkeypatch):
    monkeypatch.chdir(make(tmp_path, files))
    result = dsmoe(*words)
    assert result.status in (1, 2) and said in result.err and "Traceback" not in result.err


@pytest.mark.parametrize("words", [[], RUN[1:], ["--paper", "--", "python"]])
def test_the_names_of_trainers_are_printed(words, dsmoe):
    said = dsmoe("run", "--trainer", "list", *words)
    assert said.status == 0 and said.err == ""
    names = said.out.replace(",", " ").split()
    assert {*patches.TRAINERS, *(contract.name for contract in CONTRACTS)} <= set(names)


@pytest.mark.parametrize("gate", ["0", "0.0"])
def test_paper_takes_the_gate_that_it_stands_for(gate, dsmoe):
    assert "there is no command" in dsmoe("run", "--paper", "--background-gate", gate).err
    assert "with --paper it is 0.0, or left out" in dsmoe("run", "--paper", "--background-gate", gate + "1").err


CALLS = {  # what a checkout sets, calls with and names the results of, and the rasterizer that it needs
    "mip_splatting": ("kernel_size=1, subpixel_offset=2", "", "image, radii"),
    "mcmc": ("", "", "image, radii, is_used"), "dngaussian": ("", "", "image, radii, depth, alpha"),
    "monogs": ("projmatrix_raw=1", "theta=1", "image, radii, depth, opacity"),
    "grouping": ("", "sh_objs=1", "image, radii, rendered_objects"),
    "feature_3dgs": ("", "semantic_feature=1", "image, feature_map, radii, depth"),
    "langsplat": ("include_feature=1", "language_feature_precomp=1", "image, feature_image, radii"),
    "cob_gs": ("antialiasing=0, include_mask=0", "mask_precomp=1, mask_signals=1", "image, mask_image, radii, depth"),
    "speedy_splat": ("", "scores=1", "image, radii, kernel_times"),
    "taming": ("pixel_weights=1", "dc=1", "image, radii, counts, lists, listsRender, listsDistance, centers, depths, "
               "my_radii, accum_weights, accum_count, accum_blend, accum_dist"),
    "pixel_gs": ("depth_threshold=1", "", "image, radii, pixels"),
    "lucid_dreamer": ("", "", "image, radii, depth_alpha"),  # no depth: one image has both
    "nearest_points": ("nearest_points=1", "", "image, radii"),
    "mini_splatting": ("", "", "image, radii, weights, weight_counts, max_count"),
    "light_gaussian": ("f_count=1", "", "counts, score, image, radii"), "depth": ("", "", "image, radii, depth"),
    "absgs": ("", "", "image, radii, gs_w"), "fastgs": ("mult=1, get_flag=1", "dc=1", "image, radii, metric_counts"),
    None: ("", "", "image, radii, normals"), "inria": ("", "", "image, radii")}


@pytest.mark.parametrize("flavour", CALLS)
def test_a_rasterizer_is_recognised_by_its_settings_keywords_results_and_name(flavour, tmp_path, monkeypatch):
    module = {contract.name: contract.module for contract in CONTRACTS}.get(flavour, "diff_gaussian_rasterization")
    settings, keywords, results = CALLS[flavour]
    renderer = (f"from {module} import GaussianRasterizationSettings, GaussianRasterizer\n"
                f"draw = GaussianRasterizer(raster_settings=GaussianRasterizationSettings(bg=1, {settings}))\n"
                f"{results} = draw(means3D=1, {keywords})\n")
    monkeypatch.chdir(make(tmp_path, {GR: renderer}))
    words = [sys.executable, "train.py"], "smoe", None, environment()
    if flavour is None:
        with pytest.raises(patches.PatchError, match="returns 3 results"):
            run.prepare(*words)
        return
    made, lines = run.prepare(*words)
    named = flavour if module == "diff_gaussian_rasterization" else "inria"  # beside another name
    assert made["DSMOE_RASTERIZER"] == named and f"{module} will be {flavour} of this package" in lines[0]


FREELY = {  # settings, keywords and results that no whole contract has
    "depth,color,radii,alpha": ("kernel_size=1, subpixel_offset=2", "", "rendered_depth, image, radii, acc"),
    "color,depth,normal,median_depth,radii": (
        "clamp_color=1", "normal_precomp=1", "image, depths, render_normal, render_median_depth, radii"),
    "color,radii,depth,feature_map": ("confidence=1", "semantic_feature=1", "image, radii, depth, features"),
    "color,radii,depth": ("", "", "image, radii, depth")}


@pytest.mark.parametrize("flavour", FREELY)
def test_settings_and_results_combine_freely(flavour, tmp_path, monkeypatch):
    settings, keywords, results = FREELY[flavour]
    renderer = ("from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer\n"
                f"draw = GaussianRasterizer(raster_settings=GaussianRasterizationSettings(bg=1, {settings}))\n"
                f"{results} = draw(means3D=1, {keywords})\ndraw.visible_filter(means3D=1)\n")
    monkeypatch.chdir(make(tmp_path, {GR: renderer}))
    assert run.prepare([sys.executable, "train.py"], "smoe", None, environment())[0]["DSMOE_RASTERIZER"] == flavour
    make(tmp_path, {GR: renderer.replace("bg=1", "bg=1, f_count=1")})
    with pytest.raises(patches.PatchError, match="Settings have f_count, which come only with the results"):
        run.prepare([sys.executable, "train.py"], "smoe", None, environment())


IN_FUNCTION = ("def render_{2}():\n    from {0} import GaussianRasterizationSettings as Settings, GaussianRasterizer\n"
               "    rasterizer = GaussianRasterizer(Settings(bg=1, {3}))\n    {1} = rasterizer(means3D=1)\n"
               "used = render_{2}\n")


def test_each_package_is_told_by_its_own_calls(tmp_path, monkeypatch):
    """Classes of the file's own are not a rasterizer's, and one that is unknown is kept away where another is there."""
    words = [sys.executable, "train.py"], "smoe", None, environment()
    known = (IN_FUNCTION.format("diff_gaussian_rasterization_abs", "image, radii, depth_image", 1, "antialiasing=1")
             + IN_FUNCTION.format("diff_gaussian_rasterization", "image, radii", 2, "")
             + "class Plain: pass\ndef render_3():\n    rasterizer = Plain(1)\n    a, b = rasterizer(means3D=1)\n"
             + "used = render_3\ndef render_4():\n    rasterizer = GaussianRasterizerOfNone(1)\n"
             + "    a, b, c = rasterizer(means3D=1, own=2)\nused = render_4\n")
    monkeypatch.chdir(make(tmp_path, {GR: known}))
    made, lines = run.prepare(*words)
    assert made["DSMOE_RUN_PACKAGES"].split(os.pathsep) == [
        "diff_gaussian_rasterization=inria", "diff_gaussian_rasterization_abs=inria_2024"]
    assert "diff_gaussian_rasterization_abs will be inria_2024 of this package" in lines[0]
    unknown = IN_FUNCTION.format("diff_gauss_mask", "image, radii, pieces", 5, "")
    make(tmp_path, {GR: known + unknown})
    with pytest.raises(patches.PatchError, match="diff_gauss_mask: its rasterizer returns 3 results"):
        run.prepare(*words)  # no package is always imported
    make(tmp_path, {GR: RENAMED.format("diff_gaussian_rasterization", "image, radii") + unknown
                    + "try:\n    from diff_surfel_rasterization import GaussianRasterizer as S\nexcept E: pass\n"})
    made, lines = run.prepare(*words)
    assert made["DSMOE_RUN_PACKAGES"].split(os.pathsep) == [
        "diff_gaussian_rasterization=inria", "diff_gauss_mask=", "diff_surfel_rasterization="]
    assert [line.split()[1] for line in lines if "computes something else: an import of it fails" in line] == [
        "diff_gauss_mask", "diff_surfel_rasterization"]
    run.write_rasterizers(tmp_path / "packages", made["DSMOE_RUN_PACKAGES"])
    with pytest.raises(ImportError, match="diff_gauss_mask computes something else; this package cannot stand in"):
        exec((tmp_path / "packages/diff_gauss_mask/__init__.py").read_text())
    refused(tmp_path, "it imports diff_gauss_mask, diff_surfel_rasterization too, another rasterizer, which no patch")


RENAMED = ("from {0} import GaussianRasterizationSettings as Settings, GaussianRasterizer as Draw\n"
           "draw = Draw(raster_settings=Settings(bg=1))\n{1} = draw(means3D=1)\n")


@pytest.mark.parametrize("name, results, flavour", [
    ("diff_gaussian_rasterization_w_depth", "image, radii, depth", "depth"),
    ("depth_diff_gaussian_rasterization", "image, _, depth, alpha", "depth_alpha"),
    ("diff_gaussian_rasterization_depth", "image, radii, depth", "depth"),  # not the one that is known by that name
    ("diff_gaussian_rasterization", "color, depth, median_depth, alpha, radii", "color,depth,median_depth,alpha,radii"),
    ("diff_gauss_own", "rendered_depth, opacity, render, radii", "depth,alpha,color,radii"),
    ("diff_gaussian_rasterization", "inv_depth, image, radii", "inverse_depth,color,radii"),
    ("diff_gaussian_rasterization_w_depth", "out", "what a call returns is not seen"),
    ("diff_gauss", "image, depth, normal, alpha, radii, extra", "what normal is, no name or argument says"),
    ("diff_gaussian_rasterization", "depth, image, radii, is_used", "depth,color,radii,is_used"),
    ("diff_gaussian_rasterization", "image, radii, depth_normal", "what depth_normal is, no name"),
    ("diff_gaussian_rasterization", "image, radii, accum_max_count", "what accum_max_count is, no name"),
    ("diff_gaussian_rasterization", "radii, depth", "a name comes twice, or color or radii are not"),
    ("diff_gaussian_rasterization", "depth, depth_2, image, radii", "returns 4 results"),
    ("diff_gaussian_rasterization_panorama", "image, radii", "another rasterizer, which would render"),
    ("triangle_rasterizer", "image, radii", "another rasterizer, which would render")])
def test_another_name_or_order_is_told_by_what_callers_show(name, results, flavour, tmp_path, monkeypatch):
    monkeypatch.chdir(make(tmp_path, {GR: RENAMED.format(name, results)}))
    words = [sys.executable, "train.py"], "smoe", None, environment()
    if " " in flavour:
        with pytest.raises(patches.PatchError, match=flavour):
            run.prepare(*words)
        return
    made, lines = run.prepare(*words)
    assert made["DSMOE_RUN_PACKAGES"] == f"{name}={flavour}"
    assert f"{name} will be {flavour} of this package" in lines[0]
    is_renamed, is_ordered = name != "diff_gaussian_rasterization", "," in flavour
    assert [word in "".join(lines) for word in ("is taken for", "the results are told")] == [is_renamed, is_ordered]
    refused(tmp_path, "for which there is no patch: type `dsmoe run" if is_renamed or is_ordered else "unpatchable")


OWN = "submodules/own/diff_gaussian_rasterization/__init__.py"
SOURCE = """import torch
class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means3D, raster_settings):
        return {0}
    @staticmethod
    def backward(ctx, *gradients):
        return None, None
class GaussianRasterizer(torch.nn.Module):
    def forward(self, means3D):
        return {1}
"""


@pytest.mark.parametrize("called, returned, passed, flavour", [
    # What callers do not unpack, or name by words that say nothing.
    ("out", "color, radii, depth, alpha", "_Rasterize.apply(means3D)", "depth_alpha"),
    ("a, b, c", "color, radii, invdepths", "_Rasterize.apply(means3D)", "inria_2024"),
    ("image, depths, _, radii", "color, depth, alpha, radii", "_Rasterize.apply(means3D)", "color,depth,alpha,radii"),
    # What contradicts callers, is changed on its way, or has no names, counts as if it were not there.
    ("image, radii, depth, alpha", "color, radii, alpha, depth", "_Rasterize.apply(means3D)", "depth_alpha"),
    ("image, radii", "color, radii, depth", "_Rasterize.apply(means3D)", "inria"),
    ("out", "color, radii, depth", "_Rasterize.apply(means3D)[:2]", "what a call returns is not seen"),
    ("out", "color, torch.ones(1)", "_Rasterize.apply(means3D)", "what a call returns is not seen"),
    ("out", "outputs", "_Rasterize.apply(means3D)", "what a call returns is not seen"),
    ("image, radii, depth, alpha", "color, radii, depth, normal", "_Rasterize.apply(means3D)", "what normal is, no")])
def test_a_rasterizer_in_the_checkout_says_what_it_returns(called, returned, passed, flavour, tmp_path, monkeypatch):
    text = RENAMED.format("diff_gaussian_rasterization", called).replace("bg=1", "bg=1, antialiasing=1") if (
        "inv" in returned) else RENAMED.format("diff_gaussian_rasterization", called)
    monkeypatch.chdir(make(tmp_path, {GR: text, OWN: SOURCE.format(returned, passed)}))
    words = [sys.executable, "train.py"], "smoe", None, environment()
    if " " in flavour:
        with pytest.raises(patches.PatchError, match=flavour):
            run.prepare(*words)
    else:
        assert run.prepare(*words)[0]["DSMOE_RASTERIZER"] == flavour


def test_copies_of_a_rasterizer_that_differ_say_nothing(tmp_path, monkeypatch):
    other = OWN.replace("own", "other")
    text = RENAMED.format("diff_gaussian_rasterization", "out")
    monkeypatch.chdir(make(tmp_path, {
        GR: text, OWN: SOURCE.format("color, radii", "f()"), other: SOURCE.format("color, radii, depth", "f()")}))
    with pytest.raises(patches.PatchError, match="what a call returns is not seen"):
        run.prepare([sys.executable, "train.py"], "smoe", None, environment())


def test_a_function_that_nothing_names_says_nothing(tmp_path, monkeypatch):
    """Unless functions are called by texts that are made up."""
    dead = "def render_masks():\n    import diff_surfel_rasterization\n    a, b, c = rasterizer(means3D=1, masks=2)\n"
    text = RENAMED.format("diff_gaussian_rasterization", "image, radii") + dead
    monkeypatch.chdir(make(tmp_path, {GR: text}))
    words = [sys.executable, "train.py"], "smoe", None, environment()
    assert run.prepare(*words)[0]["DSMOE_RUN_PACKAGES"] == "diff_gaussian_rasterization=inria"
    for caller in ("from gaussian_renderer import render_masks", "getattr(gaussian_renderer, name)()",
                   "globals()['render_' + kind]()"):
        make(tmp_path, {GR: text, "train.py": f"import gaussian_renderer\n{caller}\ndef training(): pass\n"})
        with pytest.raises(patches.PatchError, match="called with masks, which no rasterizer has"):
            run.prepare(*words)


def test_what_a_checkout_imports_is_compared_with_the_trainer_that_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(make(tmp_path, {GR: "from diff_gaussian_rasterization import compute_relocation\n" + RENDERER}))
    words = [sys.executable, "train.py"], "smoe"
    with pytest.raises(patches.PatchError, match="imports compute_relocation from diff_.*, which the rasterizer inria "
                                                 "has not; --trainer inria cannot help"):
        run.prepare(*words, "inria", environment())
    assert run.prepare(*words, "mcmc", environment())[0]["DSMOE_RASTERIZER"] == "mcmc"


def test_a_word_of_a_known_rasterizer_is_told_by_that(tmp_path, monkeypatch):
    text = RENAMED.format("diff_gaussian_rasterization", "image, radii, kernel_times, depth")
    monkeypatch.chdir(make(tmp_path, {GR: text}))
    with pytest.raises(patches.PatchError, match="kernel_times comes only in the results of speedy_splat: color"):
        run.prepare([sys.executable, "train.py"], "smoe", None, environment())


def test_a_renamed_rasterizer_with_results_in_another_order_renders(tmp_path, python):
    script = """import torch
from diff_gaussian_rasterization_named import GaussianRasterizationSettings, GaussianRasterizer
draw = GaussianRasterizer(raster_settings=GaussianRasterizationSettings(
    image_height=8, image_width=8, tanfovx=1.0, tanfovy=1.0, bg=torch.zeros(3), scale_modifier=1.0,
    viewmatrix=torch.eye(4), projmatrix=torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, -0.01, 0]]),
    sh_degree=0, campos=torch.zeros(3), prefiltered=False, debug=False))
color, depth, median_depth, alpha, radii = draw(
    means3D=torch.tensor([[0.0, 0, 2]]), means2D=None, opacities=torch.ones(1, 1), colors_precomp=torch.ones(1, 3),
    scales=torch.full((1, 3), 2.0), rotations=torch.tensor([[1.0, 0, 0, 0]]))
print(list(color.shape), [round(one[0, 4, 4].item(), 1) for one in (depth, median_depth, alpha)], radii.dtype)
"""
    make(tmp_path, {GR: None, "x.py": script})
    before = contents(tmp_path)
    result = python("-m", "dsmoe", "run", "--blend-mode", "alpha", "--", sys.executable, "x.py",
                    cwd=tmp_path, PYTHONPATH=str(PACKAGE_PARENT))
    assert result.out == "[3, 8, 8] [2.0, 2.0, 1.0] torch.int32\n", result.err
    assert contents(tmp_path) == before


@pytest.mark.parametrize("like_3dgs", [True, False])
def test_the_script_that_is_run_says_which_renderer_counts(like_3dgs, tmp_path, monkeypatch):
    """Each of two scripts has its own renderer; what the rest imports has to be there."""
    files = {"gaussian_renderer/a.py": RENAMED.format("diff_gaussian_rasterization", "image, radii, depth, alpha"),
             GR: "", "gaussian_renderer/b.py": RENAMED.format("diff_surfel_rasterization", "image, radii, allmap"),
             "train_a.py": "from gaussian_renderer.a import render\n", "scene/gaussian_model.py": "import utils.more\n",
             "train_b.py": "def later():\n    import gaussian_renderer.b\n", "train.py": None, "render.py": None,
             "train_c.py": "from scene.gaussian_model import M\nfrom gaussian_renderer.a import render\n",
             "utils/more.py": "from diff_gaussian_rasterization import cuda_knn\n"}
    if not like_3dgs:  # the same in another layout
        files = {name.replace("gaussian_renderer", "draw"): text and text.replace("gaussian_renderer", "draw")
                 for name, text in {**files, GR: None}.items()}
        files[GR] = None
    monkeypatch.chdir(make(tmp_path, files))

    def of(script):
        return run.prepare([sys.executable, *script], "smoe", None, environment())[0]["DSMOE_RASTERIZER"]

    assert of(["train_a.py"]) == of(["-m", "train_a"]) == "depth_alpha"
    for script, said in (("train_b.py", "diff_surfel_rasterization, another"), ("train_c.py", "it imports cuda_knn")):
        with pytest.raises(patches.PatchError, match=said):
            of([script])


def test_a_folder_of_checkouts_is_told_which_they_are(tmp_path, monkeypatch):
    make(tmp_path / "one", {GR: GOF})
    monkeypatch.chdir(make(tmp_path, {GR: None, "train.py": None}))
    with pytest.raises(patches.PatchError, match="but in one: change into that folder"):
        run.prepare([sys.executable, "x.py"], "smoe", None, environment())
    make(tmp_path / "deep/two")
    refused(tmp_path, f"there is no {GR} in it, but in deep/two, one: name one of these")


def test_a_rasterizer_of_another_name_is_answered_for_by_that_name(tmp_path, python):
    modules = {contract.module: contract.name for contract in CONTRACTS
               if contract.module not in ("diff_gaussian_rasterization", "gsplat")}
    assert len(modules) == 4
    modules["diff_gaussian_rasterization"] = "inria"  # beside such a one, as Mini-Splatting's renderer has both
    script = "".join(f"from {module} import GaussianRasterizer, GaussianRasterizationSettings\n"
                     "GaussianRasterizer(None)\n" for module in modules)
    make(tmp_path, {"x.py": script})
    result = python("-m", "dsmoe", *RUN, "--trainer", "absgs", "--", sys.executable, "x.py",
                    cwd=tmp_path, PYTHONPATH=str(PACKAGE_PARENT))
    assert result.status == 0, result.err
    said = [line.split()[4] for line in result.err.splitlines() if "the rasterizer is" in line]
    assert said == list(modules.values()), result.err


def test_mini_splatting_has_two_rasterizers_and_a_method(tmp_path, monkeypatch):
    own = ("    from {0} import GaussianRasterizer\n    draw = GaussianRasterizer(raster_settings=1)\n"
           "    {1} = draw(means3D=1)\n")
    both = RENDERER + "def render_1():\n" + own.format("diff_gaussian_rasterization", "image, radii") + \
        "def render_2():\n" + own.format("diff_gaussian_rasterization_ms", "image, radii, weights, count, max_count")
    both = "used = 'render_1, render_2'\n" + both
    monkeypatch.chdir(make(tmp_path, {GR: both + "    draw.render_depth(means3D=1)\n"}))
    words = [sys.executable, "train.py"], "smoe", None, environment()
    assert "diff_gaussian_rasterization_ms will be mini_splatting" in run.prepare(*words)[1][0]
    make(tmp_path, {GR: both + "    draw.render_normals(means3D=1)\n"})
    with pytest.raises(patches.PatchError, match="has a method render_normals, which no rasterizer has"):
        run.prepare(*words)


GSPLAT = {  # a gsplat of some lines: its version, and a strategy that has taken its functions by name
    "gsplat/__init__.py": "from .rendering import rasterization\nfrom .relocation import compute_relocation\n"
                          "from .cuda import quat_scale_to_covar_preci\nfrom . import strategy\n"
                          "__version__ = '{version}'\n",
    "gsplat/rendering.py": "def rasterization(*a, **k): raise SystemExit('theirs')\n",
    "gsplat/relocation.py": "compute_relocation = 'theirs'\n",
    "gsplat/cuda.py": "quat_scale_to_covar_preci = 'theirs'\n", "gsplat/strategy/__init__.py": "from . import ops\n",
    "gsplat/strategy/ops.py": "from gsplat import quat_scale_to_covar_preci\n"
                              "from gsplat.relocation import compute_relocation\n"}
CALL_GSPLAT = """import torch
from gsplat.rendering import rasterization
view, K = torch.eye(4)[None], torch.tensor([[[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]])
means = torch.tensor([[0.0, 0, 2]])
image, alphas, meta = rasterization(means, torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.3), torch.ones(1),
                                    torch.ones(1, 3), view, K, 8, 8, packed=False)
print(image.max().item() > 0.5, list(meta["radii"].shape))
"""
INRIA_2024_IMPORT = "from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer\n"
CALL_STRATEGY = """from gsplat.strategy import ops
print(ops.compute_relocation.__module__, ops.quat_scale_to_covar_preci.__module__)
"""


@pytest.mark.parametrize("version, radii", [("1.4.0", [1, 1]), ("1.6.0+cu13", [1, 1, 2]), (None, [1, 1, 2])])
def test_gsplat_gets_this_rasterizer_and_keeps_its_strategies(version, radii, tmp_path, python):
    """version None: gsplat is not installed, and only the rasterizer is there."""
    make(tmp_path, {GR: None, "x.py": CALL_GSPLAT + (CALL_STRATEGY if version else "")})
    installed = tmp_path / "installed"
    for name, text in GSPLAT.items() if version else ():
        (installed / name).parent.mkdir(parents=True, exist_ok=True)
        (installed / name).write_text(text.replace("{version}", version))
    result = python("-m", "dsmoe", *RUN, "--", sys.executable, "x.py", cwd=tmp_path,
                    PYTHONPATH=os.pathsep.join([str(PACKAGE_PARENT), str(installed)]))
    assert result.status == 0, result.err
    ours = "diff_smoe_rasterization.integrations.gsplat"
    assert result.out.splitlines() == [f"True {radii}", *([f"{ours} {ours}"] if version else [])]
    assert "gsplat will be gsplat of this package, blend mode smoe" in result.err


@pytest.mark.parametrize("main, module, chosen", [
    ("from gsplat import rasterization\n", "gsplat", True), ("from gsplat import rasterization\n", "gsplat", False),
    (INRIA_2024_IMPORT, "gsplat.rendering", True)])
def test_another_rasterizer_of_gsplats_that_a_config_names_ends_the_command(main, module, chosen, tmp_path, python):
    """It is told at the start, and nothing is trained by it."""
    script = (f"{main}import {module}\nif {chosen}:\n    {module}.rasterization_2dgs(means=1)\n"
              f"{CALL_GSPLAT}print('trained')\n")
    make(tmp_path, {GR: None, "x.py": script})
    installed = tmp_path / "installed"
    for name, text in GSPLAT.items():
        (installed / name).parent.mkdir(parents=True, exist_ok=True)
        text = text.replace("import rasterization\n", "import rasterization, rasterization_2dgs\n")
        text += "def rasterization_2dgs(*a, **k): print('2dgs')\n" if "def rasterization(" in text else ""
        (installed / name).write_text(text.replace("{version}", "1.5.3"))
    result = python("-m", "dsmoe", *RUN, "--", sys.executable, "x.py", cwd=tmp_path,
                    PYTHONPATH=os.pathsep.join([str(PACKAGE_PARENT), str(installed)]))
    assert "warning: the trainer may call gsplat's rasterization_2dgs, which this package has not" in result.err
    assert result.status == chosen and result.out.endswith("trained\n") != chosen and "2dgs" not in result.out
    assert ("the trainer calls gsplat's rasterization_2dgs, which this package has not; choose" in result.err) == chosen


INRIA_2024 = ("from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer\n"
              "draw = GaussianRasterizer(raster_settings=GaussianRasterizationSettings(bg=1, antialiasing=1))\n"
              "image, radii, depth = draw(means3D=1, dc=1)\n")


@pytest.mark.parametrize("imported, called, said", [
    ("from gsplat import rasterization", "rasterization(means=1, packed=True)", ""),
    ("import gsplat as g", "g.rendering.rasterization(means=1)", ""),
    ("from gsplat.rendering import rasterization as draw", "fn = draw", ""),
    ("from gsplat import rasterization", "rasterization(means=1, colors0=2)", "rasterization with colors0, which"),
    ("def later():\n    from gsplat.cuda._torch_impl import quat_to_rotmat\nlater()", "quat_to_rotmat(1)",
     "it imports gsplat and does not call its rasterization"),
    ("import gsplat", "gsplat.rasterization_2dgs(means=1)",
     "does not call its rasterization; it calls rasterization_2dgs"),
    ("from gsplat import rasterization", INRIA_2024.replace("dc=1", "rays=1") + "rasterization(means=1)",
     "its rasterizer is called with rays")])
def test_gsplat_is_recognised_by_the_call_of_rasterization(imported, called, said, tmp_path, monkeypatch):
    monkeypatch.chdir(make(tmp_path, {GR: None, "x.py": f"{imported}\n{called}\n"}))
    words = [sys.executable, "x.py"], "smoe", None, environment()
    if said:
        with pytest.raises(patches.PatchError, match=said):
            run.prepare(*words)
    else:
        assert "gsplat will be gsplat of this package" in run.prepare(*words)[1][0]


def test_what_is_imported_from_gsplat_does_not_hide_the_rasterizer_that_is_called(tmp_path, monkeypatch):
    lazily = "def later():\n    from gsplat.cuda._torch_impl import quat_to_rotmat\n"
    monkeypatch.chdir(make(tmp_path, {GR: None, "x.py": INRIA_2024 + lazily}))
    words = [sys.executable, "x.py"], "smoe", None, environment()
    assert "will be inria_2024 of this package" in run.prepare(*words)[1][0]
    make(tmp_path, {GR: None, "x.py": INRIA_2024 + "import gsplat\ngsplat.rasterization(means=1)\n"})
    made, lines = run.prepare(*words)
    assert "gsplat will be gsplat of this package" in lines[0] and made["DSMOE_RASTERIZER"] == "inria_2024"


def test_what_speaks_against_a_trainer_that_is_named_is_said(tmp_path, dsmoe, monkeypatch):
    """reduced-3dgs: its call has other keywords."""
    one_line = "    return GaussianRasterizer(raster_settings=settings)(means3D=pc.get_xyz)\n"
    renderer = RENDERER.replace(one_line, "    draw = GaussianRasterizer(raster_settings=settings)\n"
                                          "    color, radii = draw(means3D=1, degrees=2)\n")
    monkeypatch.chdir(make(tmp_path / "reduced", {GR: renderer}))
    _, lines = run.prepare([sys.executable, "train.py"], "smoe", "inria", environment())
    assert "warning: " in lines[1] and "its rasterizer is called with degrees, which no rasterizer has" in lines[1]
    said = dsmoe(*PYTHON)
    assert said.status == 1 and "degrees" in said.err and said.err.count(GR) == 0  # no folder without a renderer
    monkeypatch.chdir(make(tmp_path / "fitting"))
    assert len(run.prepare([sys.executable, "train.py"], "smoe", "inria", environment())[1]) == 1  # nothing does
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")  # as for ns-train
    assert run.prepare([sys.executable], "smoe", "gsplat", environment())[1][1] == (
        "warning: no file that imports gsplat was found")


def test_a_trainer_of_another_layout_is_recognised_by_its_rasterizer(tmp_path, monkeypatch):
    """dreamgaussian, SplaTAM, SuGaR: settings and calls lie elsewhere, under other names."""
    (tmp_path / "main.py").write_text("import deep.renderer\n")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep/renderer.py").write_text(
        "from diff_gaussian_rasterization import GaussianRasterizationSettings as Camera\n"
        "from diff_gaussian_rasterization import GaussianRasterizer as Renderer\n"
        "image, radii, depth, alpha = Renderer(raster_settings=Camera())(means3D=1)\n"
        "rasterizer = MeshRasterizer()\nfragments = rasterizer(meshes, cameras=1)\n")  # of pytorch3d
    monkeypatch.chdir(tmp_path)
    made, lines = run.prepare([sys.executable, "main.py"], "smoe", None, environment())
    assert made["DSMOE_RASTERIZER"] == "depth_alpha" and lines[0].startswith(f"the trainer in {tmp_path}: ")


OF_2024 = RENDERER.replace("bg=bg_color", "antialiasing=False, bg=bg_color")
IMPORT_SPARSE = "from diff_gaussian_rasterization import SparseGaussianAdam\n"
TRY_SPARSE = """from diff_gaussian_rasterization import GaussianRasterizer
try:
    from diff_gaussian_rasterization import SparseGaussianAdam
except ImportError:
    SparseGaussianAdam = None
print(SparseGaussianAdam is not None)
GaussianRasterizer(None)
"""


@pytest.mark.parametrize("files, words, is_offered", [
    ({}, [], False),  # the model can be rendered for it, and still the rest of a fork may not know it
    ({}, ["--optimizer_type", "sparse_adam"], True), ({"train.py": IMPORT_SPARSE + TRY_SPARSE}, [], True),
    ({"arguments/__init__.py": "class A:\n    optimizer_type: str = 'sparse_adam'\n"}, [], True),
    ({"submodules/own/diff_gaussian_rasterization/__init__.py": "class SparseGaussianAdam: 0\n"}, [], True)])
def test_sparse_adam_is_offered_to_what_was_written_for_it(files, words, is_offered, tmp_path, python):
    """If 3DGS of 2024 finds it, it renders another way; forks for the branch without it break there."""
    model = "class GaussianModel:\n    def get_features_dc(self): ...\n"
    make(tmp_path, {GR: OF_2024, "train.py": TRY_SPARSE, "scene/gaussian_model.py": model, **files})
    result = python("-m", "dsmoe", *PYTHON, *words, cwd=tmp_path, PYTHONPATH=str(PACKAGE_PARENT))
    assert (result.status, result.out) == (0, f"{is_offered}\n"), result.err


def test_rasterizers_of_one_name_are_named(tmp_path):
    """op43dgs has two rasterizers of one name; only one is installed."""
    make(tmp_path, {f"submodules/{lens}/diff_gaussian_rasterization/__init__.py": "" for lens in ("fish", "pinhole")})
    words = [sys.executable, str(tmp_path / "train.py")], "smoe", None, environment()
    assert "warning: the checkout has fish, pinhole, all called" in run.prepare(*words)[1][1]
    assert "the checkout has fish, pinhole, all called" in patches.check(tmp_path).notes[0]
    (tmp_path / "submodules/fish").rename(tmp_path / "fish")
    assert len(run.prepare(*words)[1]) == 1


def test_a_patched_checkout_is_refused_until_nothing_of_the_patch_is_left(tmp_path):
    patches.apply(make(tmp_path))
    words = [sys.executable, str(tmp_path / "train.py")], "smoe", None, environment()
    with pytest.raises(patches.PatchError, match="patched already"):
        run.prepare(*words)
    make(tmp_path)  # as git checkout does
    assert run.prepare(*words)


def test_the_package_brings_the_stand_ins_and_nothing_beside_itself():
    """Not one of the names that they stand in for is installed as such."""
    packages, data = packages_and_data()
    assert {name.partition(".")[0] for name in packages} == {"diff_smoe_rasterization", "dsmoe"}
    patches = ROOT / "dsmoe" / "patches"
    brought = {path for pattern in data["dsmoe.patches"] for path in patches.glob(pattern)}
    assert set() != set((patches / "stand_ins").rglob("*.py")) <= brought
    for contract in CONTRACTS:
        module = importlib.import_module(f"diff_smoe_rasterization.integrations.{contract.name}")
        names = NAMES if contract.module != "gsplat" else ("rasterization",)
        assert {*names, *contract.names} <= set(module.__all__)


KERNEL = """// float alpha = 0;
renderCUDA() {
    float power = -0.5f * (con_o.x * d.x * d.x + con_o.z * d.y * d.y) - con_o.y * d.x * d.y;
    float alpha = min(0.99f, con_o.w * exp(power));
    const float weight = alpha * T;
    C[ch] += features[collected_id[j] * CHANNELS + ch] * alpha * T;
    D += depth[id[j]] * weight;
    out_color[ch * H * W + pix_id] = C[ch] + T * bg_color[ch];
}
"""


@pytest.mark.parametrize("old, new, named", [
    ("", "", None), ("* alpha * T", "* weight", None), ("exp(power)", "__expf(power)", None),
    ("-0.5f * (con_o.x * d.x * d.x + con_o.z * d.y * d.y)", "-0.5f * d.x * d.x", "the exponent"),
    ("con_o.w * exp(power)", "con_o.w * exp(power) * 0.5f", "alpha"),
    ("weight = alpha * T", "weight = T", "the weight"),
    ("* alpha * T", "* alpha * weight", "the colour"), ("C[ch] + T", "C[ch] / sum + T", "the pixel")])
@pytest.mark.parametrize("package", ["diff_gaussian_rasterization", "another"])
def test_kernels_in_the_checkout_that_blend_something_else_are_refused(old, new, named, package, tmp_path, monkeypatch):
    own = {"submodules/own/setup.py": f"setup(name='{package}')\n",
           "submodules/own/cuda_rasterizer/forward.cu": KERNEL.replace(old, new)}
    monkeypatch.chdir(make(tmp_path, own))
    words = [sys.executable, "train.py"], "smoe"
    if named is None or package == "another":
        assert patches.check(tmp_path).state == "patchable"
        run.prepare(*words, None, environment())
        return
    said = f"forward.cu blends something else than 3DGS: {named} there is"
    with pytest.raises(patches.PatchError, match=said):
        run.prepare(*words, None, environment())
    planned = patches.check(tmp_path)
    assert planned.state == "unknown" and said in planned.reasons[0]
    assert said in run.prepare(*words, "inria", environment())[1][1], "named on request, with a warning"
    assert any(said in note for note in patches.check(tmp_path, trainer="3dgs-2023").notes)


def test_a_python_without_this_package_is_named(tmp_path, dsmoe, monkeypatch):
    monkeypatch.chdir(make(tmp_path))
    bare = tmp_path / "bin/python3"
    bare.parent.mkdir()
    bare.write_text(f"#!/bin/sh\nPYTHONPATH= exec {sys.executable} -S -E \"$@\"\n")
    bare.chmod(0o755)
    result = dsmoe(*RUN, "--", bare, "train.py")
    assert result.status == 1 and "has not this package, or no PyTorch: install it there" in result.err


@pytest.mark.parametrize("variable", [None, "0"])
def test_checkpoints_of_more_than_tensors_load(variable, tmp_path, monkeypatch):
    monkeypatch.chdir(make(tmp_path))
    given = {} if variable is None else {"TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": variable}
    made, _ = run.prepare([sys.executable, "train.py"], "smoe", None, environment(**given))
    assert made["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] == (variable or "1")
