"""The sources of a patched trainer's blend mode and background gate."""
from __future__ import annotations

import contextlib
import io
import re
import sys
from collections import namedtuple
from types import SimpleNamespace

import pytest
import torch

from diff_smoe_rasterization import BLEND_MODES, GaussianRasterizationSettings, settings
from diff_smoe_rasterization.integrations import records
from diff_smoe_rasterization.settings import GATED_MODES, resolve_blend
from dsmoe.patches import runtime
from dsmoe.system import device

ALPHA = {"blend_mode": "alpha", "background_gate": None}


@pytest.fixture(autouse=True)
def a_process_of_its_own(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["train.py"])
    runtime.say.cache_clear()
    monkeypatch.setattr(settings, "blend_of_process", None)


@contextlib.contextmanager
def warned(match):
    """Asserts that stderr has a warning that matches; None: that it has none."""
    with contextlib.redirect_stderr(io.StringIO()) as stderr:
        yield stderr
    assert re.search(f"(?m)^diff_smoe_rasterization: warning: .*{match or ''}", stderr.getvalue()) if match else (
        "warning" not in stderr.getvalue()), stderr.getvalue()
    sys.stderr.write(stderr.getvalue())


def run(mode, gate="", **more):
    """What a trainer extracts of the command line; without `gate` the option is not typed."""
    return SimpleNamespace(blend_mode=mode, background_gate=gate, **more)


def test_the_default_is_alpha_or_the_variable(monkeypatch):
    assert runtime.default_blend() == ("alpha", "")
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smoe_tn")
    assert runtime.default_blend() == ("smoe_tn", "")
    monkeypatch.setenv("DSMOE_BLEND_MODE", "paper")
    assert records.blend_of_process()[:3] == tuple(AUTHORS.values()), "a file that is read before the options"
    for default, blend in ((runtime.default_blend, runtime.blend_of), (runtime.default_smoe, runtime.smoe_of)):
        assert blend(run(*default())) == AUTHORS
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smo")
    with pytest.raises(ValueError, match="DSMOE_BLEND_MODE is 'smo'.*alpha, smoe, smoe_eq7, smoe_tn, smoe_std"):
        runtime.default_blend()


@pytest.mark.parametrize("mode", BLEND_MODES)
@pytest.mark.parametrize("variable", [None, "0.25"])
def test_the_blend_of_a_run(mode, variable, monkeypatch):
    """In GATED_MODES the gate is the mode's or the variable's; no other mode has one, whatever that says."""
    if variable:
        monkeypatch.setenv("DSMOE_BACKGROUND_GATE", variable)
    own = "learned" if mode == "smoe" else 0.0
    gate = (float(variable) if variable else own) if mode in GATED_MODES else None
    for dataset in (run(mode, white_background=False), run(mode, gate if mode in GATED_MODES else 0.0)):
        with warned(None):
            assert runtime.blend_of(dataset) == {"blend_mode": mode, "background_gate": gate}
        assert (dataset.blend_mode, dataset.background_gate) == (mode, gate)  # what is saved of it


@pytest.mark.parametrize("mode, gate", [("smoe", 0.25), ("smoe_tn", 0), ("alpha", 1)])
def test_settings_that_name_no_mode_have_that_of_the_run(mode, gate, monkeypatch):
    """Somebody may delete the patch's line in the renderer; what stderr says is what is rendered."""
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smoe_std")
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "0.5")
    runtime.blend_of(run(mode, "0.25" if mode == "smoe" else ""))
    nameless = GaussianRasterizationSettings._field_defaults
    assert resolve_blend(SimpleNamespace(**nameless)) == (mode, gate)
    monkeypatch.delenv("DSMOE_BLEND_MODE")
    monkeypatch.delenv("DSMOE_BACKGROUND_GATE")  # and the next run of the process has the defaults again
    assert runtime.default_blend()[0] == "alpha" and runtime.blend_of(run("smoe"))["background_gate"] == "learned"


def test_a_gate_that_is_typed_wins(monkeypatch):
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "0.25")
    assert runtime.blend_of(run("smoe", "0"))["background_gate"] == 0


@pytest.mark.parametrize("mode, gate, variable, message", [
    ("smoe", "-1", "", "background_gate is '-1'; it must be a number, 0 or more and at most 1e.30, or 'learned'$"),
    ("smoe", "learnt", "", "background_gate is 'learnt'; it must be a number, .*'learned'$"),
    ("smoe", "nan", "", "'nan'; it must be"), ("alpha", "learned", "", "only 'smoe' and 'smoe_eq7' know it"),
    ("smoe", "", "y", "DSMOE_BACKGROUND_GATE is 'y'"),
    ("alpha", "0.1", "", "blend_mode is 'alpha'; only 'smoe' and 'smoe_eq7' know it"),
    ("smoe_std", "0", "", "'smoe_std'; only")])
def test_a_wrong_gate_is_refused_by_name(mode, gate, variable, message, monkeypatch):
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", variable)
    with pytest.raises(ValueError, match=message):
        runtime.blend_of(run(mode, gate))


def test_a_model_in_smoe_without_a_gate_has_0_and_says_so(tmp_path):
    (tmp_path / "cfg_args").write_text("Namespace(blend_mode='smoe')")
    old = SimpleNamespace(blend_mode="smoe", model_path=str(tmp_path))
    with warned("records no background gate, so it is 0 "):
        assert runtime.blend_of(old) == {"blend_mode": "smoe", "background_gate": 0}


def test_the_papers_program_is_a_word_for_three_settings(tmp_path, monkeypatch):
    """A model's cfg_args records all three. Renderings of the process that name none have them."""
    typed = run("paper")
    assert runtime.blend_of(typed) == AUTHORS == {name: getattr(typed, name) for name in AUTHORS}
    assert settings.resolve_faint_below("smoe", None) == 2
    ours = model(tmp_path, "Namespace(blend_mode='smoe', background_gate=0.0, faint_below=2.0, eval=True)")
    assert runtime.saved_blend_of(ours) == AUTHORS
    runtime.blend_of(run("smoe", "0"))
    assert settings.resolve_faint_below("smoe", None) == 0.25
    monkeypatch.setenv("DSMOE_FAINT_BELOW", "0.9")
    assert runtime.blend_of(run("smoe", "0"))["faint_below"] == settings.resolve_faint_below("smoe", None) == 0.9
    assert runtime.blend_of(run("alpha")) == ALPHA
    for zero in ("0", "0.0", 0, None):
        assert runtime.blend_of(run("paper", zero)) == AUTHORS
    with pytest.raises(ValueError, match="gate is '0.5'; with the blend mode paper it is 0, or left out"):
        runtime.blend_of(run("paper", "0.5"))


AUTHORS = {"blend_mode": "smoe", "background_gate": 0, "faint_below": 2}  # as the paper's authors' program renders


def test_the_authors_trainer_blends_by_smoe_with_all_tails_unless_told_otherwise(monkeypatch):
    assert runtime.default_smoe() == ("smoe", "") and runtime.smoe_of(run("smoe")) == AUTHORS
    assert runtime.smoe_of(run("smoe", "0.25")) == {**AUTHORS, "background_gate": 0.25}
    assert runtime.smoe_of(run("alpha")) == ALPHA
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smoe_tn")
    assert runtime.default_smoe() == ("smoe_tn", "")


def test_a_model_of_the_authors_program_is_smoe_without_a_warning(tmp_path):
    """Their cfg_args knows no mode. What the patch records wins, and an alpha model stays one."""
    theirs = model(tmp_path, "Namespace(data_device='cuda', eval=True, images='images', init_path='default', model_path"
                             "='out-temp', resolution=-1, sh_degree=3, source_path='/data/x', white_background=False)")
    with warned(None) as said:
        assert runtime.saved_smoe_of(theirs) == AUTHORS
        assert "records no blend mode, so it is smoe with the gate 0" in said.getvalue()
        ours = model(tmp_path, "Namespace(blend_mode='smoe', background_gate=0.5, init_path='default')")
        assert runtime.saved_smoe_of(ours) == {**AUTHORS, "background_gate": 0.5}
        assert runtime.saved_smoe_of(model(tmp_path, "Namespace(blend_mode='alpha', background_gate=None)")) == ALPHA


@pytest.mark.parametrize("dataset", [SimpleNamespace(), SimpleNamespace(blend_mode=None, background_gate=None)])
def test_an_old_model_is_alpha_and_says_so_once(dataset):
    with warned("records no blend mode"):
        assert runtime.blend_of(dataset) == ALPHA
    assert dataset.blend_mode == "alpha"  # what is saved of it says so
    with warned(None):
        assert runtime.blend_of(SimpleNamespace(blend_mode="alpha")) == ALPHA
        assert runtime.blend_of(type(dataset)()) == ALPHA


def test_a_wrong_mode_is_refused_by_name():
    with pytest.raises(ValueError, match="mode is 'Smoe'; it must be one of alpha, smoe, smoe_eq7, smoe_tn, smoe_std"):
        runtime.blend_of(run("Smoe"))


def model(folder, text):
    """A model's folder, whose cfg_args has this text."""
    (folder / "cfg_args").write_text(text)
    return run("alpha", model_path=str(folder))


def test_one_line_says_which_mode_it_is(capsys):
    for _ in range(2):
        runtime.blend_of(run("alpha"))
        runtime.blend_of(run("smoe"))
    printed = capsys.readouterr()
    said = ["blend mode alpha\n", "blend mode smoe, background gate learned\n"]
    assert printed.out == "" and printed.err.split("diff_smoe_rasterization: ")[1:] == said


@pytest.mark.parametrize("gpu, why", [(True, "no nvcc"), (True, None), (False, "no GPU")])
def test_a_gpu_for_which_there_are_no_kernels_is_named(gpu, why, monkeypatch):
    """The trainer may ask for it only after it has read its images."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr(device, "why_no_gpu", lambda: why)
    with warned("the GPU cannot be used: no nvcc$" if gpu and why else None):
        runtime.blend_of(run("alpha"))
    runtime.say.cache_clear()
    with warned("the GPU cannot be used: no nvcc$" if gpu and why else None):
        runtime._say_rasterizer("inria")


def test_training_again_in_another_mode_is_named(monkeypatch, tmp_path):
    """A rendering without the flag has the mode of cfg_args; a training, resumed or not, has the default."""
    with warned("a run with blend_mode smoe, .* has alpha; .*--blend_mode smoe$"):
        runtime.blend_of(model(tmp_path, "Namespace(sh_degree=3, blend_mode='smoe')"))
    for text in ("Namespace(blend_mode='alpha')", "Namespace(sh_degree=3)", "", "no Python",
                 "Namespace(blend_mode=f())", "__import__('os').mkdir('x')"):
        with warned(None):
            assert runtime.blend_of(model(tmp_path, text)) == ALPHA
    monkeypatch.chdir(tmp_path)  # of no model yet: the current folder's is another
    (tmp_path / "cfg_args").write_text("Namespace(blend_mode='smoe')")
    with warned(None):
        runtime.blend_of(run("alpha", model_path=""))


def test_a_rendering_takes_the_saved_mode_whatever_default_it_brings(monkeypatch, tmp_path):
    """InstantSplat's render.py makes ModelParams with defaults, which then win over cfg_args."""
    (tmp_path / "cfg_args").write_text("Namespace(blend_mode='smoe', background_gate=0.5)")

    def rendered(*words):
        monkeypatch.setattr(sys, "argv", ["render.py", *words])
        typed = dict(zip(words[::2], words[1::2]))
        return runtime.saved_blend_of(run(typed.get("--blend_mode", "alpha"), typed.get("--background_gate", ""),
                                          model_path=str(tmp_path)))

    assert rendered() == {"blend_mode": "smoe", "background_gate": 0.5}
    with warned("is of a run with background_gate 0.5"):
        assert rendered("--background_gate", "0") == {"blend_mode": "smoe", "background_gate": 0}
    with warned("is of a run with blend_mode smoe"):
        assert rendered("--blend_mode", "alpha") == ALPHA
    monkeypatch.setattr(sys, "argv", ["render.py", "--back=2"])  # as argparse takes it too
    with warned("is of a run with background_gate 0.5"):
        assert runtime.saved_blend_of(run("alpha", "2", model_path=str(tmp_path)))["background_gate"] == 2
    (tmp_path / "cfg_args").write_text("Namespace(sh_degree=3)")
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smoe")
    with warned("records no blend mode, so it is alpha"):
        assert rendered() == ALPHA


def test_a_path_that_looks_like_an_option_is_none(monkeypatch, tmp_path):
    """Python 3.8 writes a Namespace sorted by name: the path comes last."""
    saved = "Namespace(background_gate=0.5, blend_mode='smoe', model_path='out/background_gate=0.03')"
    (tmp_path / "cfg_args").write_text(saved)
    assert runtime.saved_blend_of(run("alpha", model_path=str(tmp_path))) == {
        "blend_mode": "smoe", "background_gate": 0.5}


def test_a_renderer_with_another_rasterizer_is_refused(monkeypatch, tmp_path):
    """As after `git checkout gaussian_renderer`: the mode would be recorded, and ignored."""
    theirs = SimpleNamespace(GaussianRasterizationSettings=namedtuple("Settings", "image_height debug"),
                             __file__=str(tmp_path / "gaussian_renderer/__init__.py"))
    monkeypatch.setitem(sys.modules, "gaussian_renderer", theirs)
    with pytest.raises(RuntimeError, match="another rasterizer.*dsmoe patch check PATH"):
        runtime.blend_of(run("smoe"))
    with pytest.raises(RuntimeError, match="another rasterizer"):  # only arguments/ is patched: no blend_of is called
        runtime.default_blend()
    ours = SimpleNamespace(GaussianRasterizationSettings=GaussianRasterizationSettings)
    for renderer in (ours, SimpleNamespace()):
        monkeypatch.setitem(sys.modules, "gaussian_renderer", renderer)
        assert runtime.blend_of(run("smoe"))["blend_mode"] == "smoe"


def test_a_script_that_says_no_blend_mode_is_told_how():
    """The user's own script, which calls the patched renderer."""
    assert runtime.chosen_blend(SimpleNamespace(blend=ALPHA)) == ALPHA
    with pytest.raises(RuntimeError, match="needs the statements `from .* import saved_blend_of` and `pipe.blend"):
        runtime.chosen_blend(SimpleNamespace(debug=False))


@pytest.mark.parametrize("ends, explained", [("torch.zeros(1).cuda()", True), ("open('nowhere')", False),
                                             ("raise KeyboardInterrupt('cuda')", False)])
def test_a_trainer_that_needs_a_gpu_ends_with_a_line_that_says_so(python, tmp_path, ends, explained):
    """Behind torch's traceback; other errors are shown as before."""
    begins = "from dsmoe.patches import runtime\nimport torch\nruntime.default_blend()\nruntime.default_smoe()\n"
    done = python("-c", begins + ends, cwd=tmp_path, CUDA_VISIBLE_DEVICES="")
    assert done.status and "Traceback" in done.err
    assert done.err.count("no CUDA device is there, and this trainer's own code asks for one") == explained
    assert not explained or done.err.splitlines()[-1].endswith("; `dsmoe train` needs none")
