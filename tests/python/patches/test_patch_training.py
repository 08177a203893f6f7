"""Small trainers train, patched and unmodified under `dsmoe run`, to the same bits; the mode goes where it must.

One of them trains at every push, the others under `-m slow`.
"""
from __future__ import annotations

import re
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from checkouts import TRAINERS, contents, make_checkout

pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")

from diff_smoe_rasterization import BLEND_MODES, patches  # noqa: E402
from diff_smoe_rasterization.settings import RECOMMENDED_BACKGROUND_GATE as RECOMMENDED  # noqa: E402

RUN = ("-m", "diff_smoe_rasterization", "run", "--blend-mode")


def each_of(*trainers):
    """A parameter `name`; trainers but the first are left out of a push."""
    return pytest.mark.parametrize("name", [trainers[0], *(
        pytest.param(name, marks=pytest.mark.slow) for name in trainers[1:])])


def model(output):
    """{name: bytes} of the trained model in a folder."""
    path, = output.glob("point_cloud/iteration_*/point_cloud.npz")
    with np.load(path) as file:
        return {name: (file[name].shape, file[name].tobytes()) for name in file.files}


def pictures(output):
    return {path.relative_to(output).as_posix(): path.read_bytes() for path in sorted(output.rglob("*.png"))}


class Trained:
    """Trainers and what they have trained, each once; Trained(...)(NAME, KIND, MODE) is a folder."""

    def __init__(self, folder, scene, python):
        self.folder, self.scene, self.python, self.outputs = folder, scene, python, {}

    def checkout(self, name, kind):
        path = self.folder / f"{name} {kind}"
        if not path.is_dir():
            make_checkout(name, path)
            if kind != "plain":
                patches.apply(path, modernise=kind == "modernised", fuse=kind == "fused")
        return path

    def script(self, name, mode):
        """The words that train; c3dgs compresses what the trainer of 2023 has trained."""
        if name == "c3dgs":
            return ["compress.py", "-m", self("3dgs-2023", "patched", mode).output, "--output_vq"]
        return ["train.py", "-s", self.scene, "--quiet", "-m"]

    def __call__(self, name, kind, mode):
        key = name, kind, mode
        if key not in self.outputs:
            checkout, output = self.checkout(name, kind), self.folder / " ".join(key)
            words = [*self.script(name, mode), output]
            if kind == "plain":
                words = [*RUN, mode, "--", sys.executable, *words]
            else:
                words += ["--blend_mode", mode]
            result = self.python(*words, cwd=checkout)
            assert result.status == 0, result.err
            self.outputs[key] = SimpleNamespace(**vars(result), output=output, model=model(output),
                                                pictures=pictures(output))
        return self.outputs[key]

    def rendered(self, name, output, *words, change=("", ""), **variables):
        """The pictures that render.py of the patched trainer makes of a copy of `output`, with another cfg_args."""
        copy = shutil.copytree(output, self.folder / f"copy {len(list(self.folder.iterdir()))}",
                               ignore=shutil.ignore_patterns("*.png"))
        text = (copy / "cfg_args").read_text()
        assert re.search(change[0], text)
        (copy / "cfg_args").write_text(re.sub(*change, text))
        result = self.python("render.py", "-m", copy, *words, cwd=self.checkout(name, "patched"), **variables)
        assert result.status == 0, result.err
        return pictures(copy)


@pytest.fixture(scope="module")
def trained(tmp_path_factory, scene, python):
    return Trained(tmp_path_factory.mktemp("runs"), scene, python)


@each_of(*TRAINERS)
def test_patched_and_run_train_to_the_same_bits(name, trained):
    checkout = trained.checkout(name, "plain")
    before = contents(checkout)
    patched, plain = (trained(name, kind, "smoe") for kind in ("patched", "plain"))
    assert contents(checkout) == before, "a run writes into the checkout"
    assert patched.model == plain.model and patched.pictures == plain.pictures
    assert patched.out == plain.out and patched.model != trained(name, "patched", "alpha").model
    for mode, gate in (("alpha", None), ("smoe", RECOMMENDED)):
        saved = (trained(name, "patched", mode).output / "cfg_args").read_text()
        assert f"blend_mode='{mode}'" in saved and f"background_gate={gate}" in saved


@each_of("3dgs-2023", "c3dgs")
def test_render_uses_the_saved_mode_or_the_flag(name, trained):
    output = trained(name, "patched", "smoe").output
    saved, alpha = trained.rendered(name, output), trained.rendered(name, output, "--blend_mode", "alpha")
    assert len(saved) == 4 and all(saved[picture] != alpha[picture] for picture in saved)


@pytest.mark.slow
def test_render_uses_the_saved_gate_or_the_flag_or_0_and_without_a_saved_mode_alpha(trained):
    output = trained("3dgs-2023", "patched", "smoe").output
    saved = trained.rendered("3dgs-2023", output)
    eq_7 = trained.rendered("3dgs-2023", output, "--background_gate", "0")
    without = trained.rendered("3dgs-2023", output, change=(r", background_gate=[0-9.]+", ""),
                               DSMOE_BACKGROUND_GATE=str(RECOMMENDED))
    assert eq_7 == without and all(saved[picture] != eq_7[picture] for picture in saved)
    without = trained.rendered("3dgs-2023", output, change=(r", blend_mode='smoe'", ""))
    assert without == trained.rendered("3dgs-2023", output, "--blend_mode", "alpha")


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAINERS)
def test_a_wrong_mode_is_refused_before_anything_is_loaded(name, trained, tmp_path):
    if name == "c3dgs":
        words = ["compress.py", "-m", trained("3dgs-2023", "patched", "smoe").output, "--output_vq"]
    else:
        words = ["train.py", "-s", tmp_path / "no scene", "-m"]
    result = trained.python(*words, tmp_path / "out", "--blend_mode", "smooth", cwd=trained.checkout(name, "patched"))
    assert result.status != 0 and "smooth" in result.err and all(mode in result.err for mode in BLEND_MODES)
    assert "made_up.json" not in result.err and "loss" not in result.out


@pytest.mark.slow
def test_the_environment_gives_the_default(trained, tmp_path):
    checkout = trained.checkout("3dgs-2023", "patched")
    flag = ["--blend_mode", "alpha"]
    for words, variable, mode in (([], "smoe", "smoe"), (flag, "smoe", "alpha"), ([], "", "alpha")):
        output = tmp_path / f"{words} {variable}"
        result = trained.python("train.py", "-s", trained.scene, "--quiet", "-m", output, *words, cwd=checkout,
                                DSMOE_BLEND_MODE=variable)
        assert result.status == 0 and model(output) == trained("3dgs-2023", "patched", mode).model, result.err
    result = trained.python("train.py", "--help", cwd=checkout)
    assert "--blend_mode" in result.out and "--background_gate" in result.out and "--data_device" in result.out


@pytest.mark.slow
def test_other_ways_of_training_learn_too(trained, tmp_path):
    result = trained.python("train.py", "-s", trained.scene, "-m", tmp_path / "out", "--blend_mode", "smoe",
                            "--compute_cov3D_python", "--random_background",
                            cwd=trained.checkout("3dgs-2023", "patched"))
    assert result.status == 0, result.err
    assert len(re.findall(r": loss \d", result.out)) == 7
    assert model(tmp_path / "out") != trained("3dgs-2023", "patched", "smoe").model


@pytest.mark.slow
@pytest.mark.parametrize("name, kind", [("c3dgs", "modernised"), ("3dgs-2023", "fused")])
def test_other_kinds_of_patch_train_as_before(name, kind, trained):
    """The small trainer's ssim has boxes for windows, and stays; its Adam is its own too."""
    result = trained(name, kind, "smoe")
    assert result.model == trained(name, "patched", "smoe").model
    assert ("utils.loss_utils.ssim is not SSIM as it is fused here" in result.err) == (kind == "fused")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["patched", "plain"])
def test_scripts_that_build_commands_pass_the_mode_on(kind, trained, tmp_path):
    """By the variable, or by `dsmoe run`."""
    words = [] if kind == "patched" else [*RUN, "smoe", "--", sys.executable]
    result = trained.python(*words, "full_eval.py", trained.scene, tmp_path / "out", DSMOE_BLEND_MODE="smoe",
                            cwd=trained.checkout("3dgs-2023", kind))
    assert result.status == 0, result.err
    assert model(tmp_path / "out") == trained("3dgs-2023", "patched", "smoe").model
    assert len(pictures(tmp_path / "out")) == 1
