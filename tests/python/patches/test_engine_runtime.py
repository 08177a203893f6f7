"""Where a patched trainer's blend mode comes from."""
from __future__ import annotations

import sys
import warnings
from types import SimpleNamespace

import pytest

from diff_smoe_rasterization import BLEND_MODES
from diff_smoe_rasterization.patches import runtime


@pytest.fixture(autouse=True)
def no_earlier_warning(monkeypatch):
    monkeypatch.delenv("DSMOE_BLEND_MODE", raising=False)
    monkeypatch.setattr(sys, "argv", ["train.py"])
    runtime._warn.cache_clear()


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


def test_a_wrong_mode_is_refused_by_name():
    with pytest.raises(ValueError, match="--blend_mode is 'Smoe'; it must be one of alpha, smoe, smoe_tn, smoe_std"):
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
