"""Where a patched trainer's blend mode comes from."""
from __future__ import annotations

import sys
import warnings
from collections import namedtuple
from types import SimpleNamespace

import pytest

from diff_smoe_rasterization import BLEND_MODES, GaussianRasterizationSettings
from diff_smoe_rasterization.patches import runtime


@pytest.fixture(autouse=True)
def no_earlier_warning(monkeypatch):
    monkeypatch.delenv("DSMOE_BLEND_MODE", raising=False)
    monkeypatch.setattr(sys, "argv", ["train.py"])
    runtime._warn.cache_clear()
    runtime._say.cache_clear()


def test_the_default_is_alpha_or_the_variable(monkeypatch):
    assert runtime.default_blend_mode() == "alpha"
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smoe_tn")
    assert runtime.default_blend_mode() == "smoe_tn"
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smo")
    with pytest.raises(ValueError, match="DSMOE_BLEND_MODE is 'smo'.*alpha, smoe, smoe_tn, smoe_std"):
        runtime.default_blend_mode()


@pytest.mark.parametrize("mode", BLEND_MODES)
def test_the_mode_of_a_run(mode):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert runtime.blend_mode_of(SimpleNamespace(blend_mode=mode, white_background=False)) == mode


@pytest.mark.parametrize("dataset", [SimpleNamespace(), SimpleNamespace(blend_mode=None)])
def test_an_old_model_is_alpha_and_says_so_once(dataset):
    with pytest.warns(UserWarning, match="records no blend mode"):
        assert runtime.blend_mode_of(dataset) == "alpha"
    assert dataset.blend_mode == "alpha"  # what is saved of it says so
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert runtime.blend_mode_of(SimpleNamespace(blend_mode="alpha")) == "alpha"
        assert runtime.blend_mode_of(type(dataset)()) == "alpha"


def test_a_wrong_mode_is_refused_by_name(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["train.py", "--blend_mode=Smoe"])
    message = "'Smoe', as --blend_mode says; it must be one of alpha, smoe, smoe_tn, smoe_std"
    with pytest.raises(ValueError, match=message):
        runtime.blend_mode_of(SimpleNamespace(blend_mode="Smoe"))


def test_a_variable_that_does_not_count_is_named(monkeypatch):
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smoe")
    with pytest.warns(UserWarning, match="DSMOE_BLEND_MODE is smoe, but the blend mode is alpha"):
        assert runtime.blend_mode_of(SimpleNamespace(blend_mode="alpha")) == "alpha"


@pytest.mark.parametrize("arguments, white", [(["--random_background"], False), ([], True)])
def test_a_background_that_changes_its_meaning_is_named(monkeypatch, arguments, white):
    monkeypatch.setattr(sys, "argv", ["train.py"] + arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        runtime.blend_mode_of(SimpleNamespace(blend_mode="alpha", white_background=white))
    with pytest.warns(UserWarning, match="_background with blend mode smoe: the background shows only where no gate"):
        runtime.blend_mode_of(SimpleNamespace(blend_mode="smoe", white_background=white))


def model(folder, text):
    """A model's folder, whose cfg_args has this text."""
    (folder / "cfg_args").write_text(text)
    return SimpleNamespace(model_path=str(folder), blend_mode="alpha")


def test_one_line_says_which_mode_it_is_and_whence(monkeypatch, tmp_path, capsys):
    def said(dataset, *words):
        monkeypatch.setattr(sys, "argv", ["train.py", *words])
        runtime._say.cache_clear()
        runtime.blend_mode_of(dataset)
        runtime.blend_mode_of(dataset)
        printed = capsys.readouterr()
        assert printed.out == ""
        return printed.err.split("diff_smoe_rasterization: ")[1:]

    alpha, smoe = SimpleNamespace(blend_mode="alpha"), SimpleNamespace(blend_mode="smoe")
    assert said(alpha) == ["blend mode alpha, the default\n"]
    for words in (["--blend_mode", "smoe"], ["--blend_mode=smoe"], ["--blend", "smoe"]):
        assert said(smoe, *words) == ["blend mode smoe, as --blend_mode says\n"]
    saved = model(tmp_path, "Namespace(data_device='cuda', blend_mode='alpha', eval=False)")
    assert said(saved) == [f"blend mode alpha, as in {tmp_path}/cfg_args\n"]
    monkeypatch.setenv("DSMOE_BLEND_MODE", "smoe")
    assert said(smoe) == ["blend mode smoe, as in DSMOE_BLEND_MODE\n"]


def test_training_again_in_another_mode_is_named(monkeypatch, tmp_path):
    """A rendering without the flag has the mode of cfg_args; a training, resumed or not, has the default."""
    with pytest.warns(UserWarning, match="records blend mode smoe, .* has alpha, the default.*--blend_mode smoe"):
        runtime.blend_mode_of(model(tmp_path, "Namespace(sh_degree=3, blend_mode='smoe')"))
    for text in ("Namespace(blend_mode='alpha')", "Namespace(sh_degree=3)", "", "no Python",
                 "Namespace(blend_mode=f())", "__import__('os').mkdir('x')"):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert runtime.blend_mode_of(model(tmp_path, text)) == "alpha"
    monkeypatch.chdir(tmp_path)  # of no model yet: the current folder's is another
    (tmp_path / "cfg_args").write_text("Namespace(blend_mode='smoe')")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        runtime.blend_mode_of(SimpleNamespace(model_path="", blend_mode="alpha"))


def test_a_renderer_with_another_rasterizer_is_refused(monkeypatch, tmp_path):
    """As after `git checkout gaussian_renderer`: the mode would be recorded, and ignored."""
    theirs = SimpleNamespace(GaussianRasterizationSettings=namedtuple("Settings", "image_height debug"),
                             __file__=str(tmp_path / "gaussian_renderer/__init__.py"))
    monkeypatch.setitem(sys.modules, "gaussian_renderer", theirs)
    with pytest.raises(RuntimeError, match=f"another rasterizer.*dsmoe patch check {tmp_path}$"):
        runtime.blend_mode_of(SimpleNamespace(blend_mode="smoe"))
    ours = SimpleNamespace(GaussianRasterizationSettings=GaussianRasterizationSettings)
    for renderer in (ours, SimpleNamespace()):
        monkeypatch.setitem(sys.modules, "gaussian_renderer", renderer)
        assert runtime.blend_mode_of(SimpleNamespace(blend_mode="smoe")) == "smoe"
