"""The small trainer trains, patched and unmodified under `dsmoe run`, to the same bits; the mode goes where it must."""
from __future__ import annotations

import re
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from checkouts import contents, make_checkout

from dsmoe import patches

RUN = ("-m", "dsmoe", "run", "--blend-mode")


def model(output):
    """{name: bytes} of the trained model in a folder."""
    path, = output.glob("point_cloud/iteration_*/point_cloud.npz")
    with np.load(path) as file:
        return {name: (file[name].shape, file[name].tobytes()) for name in file.files}


def pictures(output):
    return {path.relative_to(output).as_posix(): path.read_bytes() for path in sorted(output.rglob("*.png"))}


class Trained:
    """What the small trainer has trained, each once; Trained(...)(KIND, MODE) has the folder."""

    def __init__(self, folder, scene, python):
        self.folder, self.scene, self.python, self.outputs = folder, scene, python, {}

    def checkout(self, kind):
        path = self.folder / kind
        if not path.is_dir():
            make_checkout(path)
            if kind != "plain":
                patches.apply(path, fuse=kind == "fused")
        return path

    def __call__(self, kind, mode):
        if (kind, mode) not in self.outputs:
            checkout, output = self.checkout(kind), self.folder / f"{kind} {mode}"
            words = ["train.py", "-s", self.scene, "--quiet", "-m", output]
            run = [*RUN[:-1], "--paper"] if mode == "paper" else [*RUN, mode]
            words = [*run, "--", sys.executable, *words] if kind == "plain" else [*words, "--blend_mode", mode]
            result = self.python(*words, cwd=checkout)
            assert result.status == 0, result.err
            self.outputs[kind, mode] = SimpleNamespace(**vars(result), output=output, model=model(output))
        return self.outputs[kind, mode]

    def rendered(self, output, *words, change=("", ""), **variables):
        """The pictures that render.py of the patched trainer makes of a copy of `output`, with another cfg_args."""
        copy = shutil.copytree(output, self.folder / f"copy {len(list(self.folder.iterdir()))}")
        text = (copy / "cfg_args").read_text()
        assert re.search(change[0], text)
        (copy / "cfg_args").write_text(re.sub(*change, text))
        result = self.python("render.py", "-m", copy, *words, cwd=self.checkout("patched"), **variables)
        assert result.status == 0, result.err
        return pictures(copy)


@pytest.fixture(scope="module")
def trained(tmp_path_factory, scene, python):
    return Trained(tmp_path_factory.mktemp("runs"), scene, python)


def test_patched_and_run_train_to_the_same_bits(trained):
    checkout = trained.checkout("plain")
    before = contents(checkout)
    patched, plain = (trained(kind, "smoe") for kind in ("patched", "plain"))
    assert contents(checkout) == before, "a run writes into the checkout"
    assert patched.model == plain.model and patched.out == plain.out
    assert patched.model != trained("patched", "alpha").model
    for mode, gate in (("alpha", None), ("smoe", "'learned'")):
        saved = (trained("patched", mode).output / "cfg_args").read_text()
        assert f"blend_mode='{mode}'" in saved and f"background_gate={gate}" in saved


def test_the_papers_program_is_one_word_patched_and_under_run(trained):
    patched, plain = (trained(kind, "paper") for kind in ("patched", "plain"))
    assert patched.model == plain.model != trained("patched", "smoe").model
    assert "blend mode smoe, background gate 0.0, faint_below 2" in patched.err and "faint_below 2" in plain.err
    assert trained.rendered(patched.output) != trained.rendered(patched.output, change=(", faint_below=2.0", ""))


def test_render_uses_the_saved_mode_gate_or_the_flag(trained):
    output = trained("patched", "smoe").output
    said = re.search(r"records the background gate (\S+)\n", trained.python(
        "render.py", "-m", output, cwd=trained.checkout("patched")).err)
    assert float(said[1]) != pytest.approx(0.1, abs=1e-3), "the gate was not learned"
    none = trained.rendered(output, "--background_gate", "0")
    assert all(picture != trained.rendered(output)[name] for name, picture in none.items())
    saved, alpha = trained.rendered(output), trained.rendered(output, "--blend_mode", "alpha")
    assert len(saved) == 4 and all(saved[picture] != alpha[picture] for picture in saved)


@pytest.mark.slow
def test_render_uses_the_saved_gate_or_the_flag_or_0_and_without_a_saved_mode_alpha(trained):
    output = trained("patched", "smoe").output
    gate = r", background_gate='learned'"
    saved, without = (trained.rendered(output, change=(gate, text), DSMOE_BACKGROUND_GATE="0.5")
                      for text in (", background_gate=0.25", ""))
    none = trained.rendered(output, "--background_gate", "0")
    assert none == without and all(saved[picture] != none[picture] for picture in saved)
    without = trained.rendered(output, change=(r", blend_mode='smoe'", ""))
    assert without == trained.rendered(output, "--blend_mode", "alpha")


@pytest.mark.slow
def test_the_environment_gives_the_default(trained, tmp_path):
    checkout = trained.checkout("patched")
    flag = ["--blend_mode", "alpha"]
    for words, variable, mode in (([], "smoe", "smoe"), (flag, "smoe", "alpha"), ([], "", "alpha")):
        output = tmp_path / f"{words} {variable}"
        result = trained.python("train.py", "-s", trained.scene, "--quiet", "-m", output, *words, cwd=checkout,
                                DSMOE_BLEND_MODE=variable)
        assert result.status == 0 and model(output) == trained("patched", mode).model, result.err
    result = trained.python("train.py", "--help", cwd=checkout)
    assert "--blend_mode" in result.out and "--background_gate" in result.out and "--data_device" in result.out


@pytest.mark.slow
def test_an_ssim_of_its_own_trains_as_before(trained):
    """The small trainer's ssim has boxes for windows, and stays; its Adam is its own too."""
    result = trained("fused", "smoe")
    assert result.model == trained("patched", "smoe").model
    assert "utils.loss_utils.ssim is not SSIM as it is fused here" in result.err


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["patched", "plain"])
def test_scripts_that_build_commands_pass_the_mode_on(kind, trained, tmp_path):
    """By the variable, or by `dsmoe run`."""
    words = [] if kind == "patched" else [*RUN, "smoe", "--", sys.executable]
    result = trained.python(*words, "full_eval.py", trained.scene, tmp_path / "out", DSMOE_BLEND_MODE="smoe",
                            cwd=trained.checkout(kind))
    assert result.status == 0, result.err
    assert model(tmp_path / "out") == trained("patched", "smoe").model
    assert len(pictures(tmp_path / "out")) == 1
