"""The engine of the patches on a checkout of a few lines: what is planned, written, kept and put back, and when not."""
from __future__ import annotations

import hashlib
import os
import shutil
import stat
import sys
from pathlib import Path

import pytest

from diff_smoe_rasterization import patches
from diff_smoe_rasterization.patches import engine, facts
from diff_smoe_rasterization.patches import record as record_module

pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")

GR, ARGS = "gaussian_renderer/__init__.py", "arguments/__init__.py"
RENDERER = '''import math  # the camera's angles
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer


def render(camera, pc, pipe, bg_color, scaling_modifier=1.0):
    """Renders."""
    settings = GaussianRasterizationSettings(
        image_height=camera.height, bg=bg_color,  # both of the view
        prefiltered=False,  # never
        debug=pipe.debug  # slow
    )
    return GaussianRasterizer(raster_settings=settings)(means3D=pc.get_xyz)
'''
ARGUMENTS = '''class ParamGroup:
    def __init__(self, parser, name, fill_none=False):
        pass


class ModelParams(ParamGroup):
    def __init__(self, parser, sentinel=False):
        self.sh_degree = 3
        # everything above becomes an option
        super().__init__(parser, "Loading Parameters", sentinel)


class PipelineParams(ParamGroup):
    def __init__(self, parser):
        self.debug = False
        super().__init__(parser, "Pipeline Parameters")
'''
TRAIN = '''import torch
from gaussian_renderer import render


def training(dataset, opt, pipe, checkpoint):
    # the first iteration is 1
    first_iter = 0
    if checkpoint:
        first_iter = torch.load(checkpoint)
    return render(None, None, pipe, None), first_iter
'''
RENDER = '''from gaussian_renderer import render


def render_sets(dataset : object, iteration : int, pipeline : object):
    "Renders both sets."
    return render(None, None, pipeline, None)'''
CHECKOUT = {GR: RENDERER, ARGS: ARGUMENTS, "train.py": TRAIN,
            "render.py": RENDER}
PATCHED = {
    GR: RENDERER.replace(
        "from diff_gaussian_rasterization import", "from diff_smoe_rasterization.integrations.inria import").replace(
        "# never\n", "# never\n        **pipe.blend,\n"),
    ARGS:
        "from diff_smoe_rasterization.patches.runtime import default_blend\n" + ARGUMENTS.replace(
            "sh_degree = 3\n", "sh_degree = 3\n        self.blend_mode, self.background_gate = default_blend()\n"),
    "train.py": TRAIN.replace("import render\n", "import render\nfrom diff_smoe_rasterization.patches.runtime import "
                              "blend_of\n").replace(
        "checkpoint):\n", "checkpoint):\n    pipe.blend = blend_of(dataset)\n"),
    "render.py": RENDER.replace("import render\n", "import render\nfrom diff_smoe_rasterization.patches.runtime import "
                                "blend_of\n").replace(
        'sets."\n', 'sets."\n    pipeline.blend = blend_of(dataset)\n'),
}


def make(folder: Path, changes=None):
    """Writes the checkout; changes: other texts, or bytes, by name; None leaves a file out."""
    for name, text in {**CHECKOUT, **(changes or {})}.items():
        if text is not None:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder


def snapshot(folder: Path):
    """Everything below a folder: bytes, modes, and what links point to."""
    return {path.relative_to(folder).as_posix(): (stat.S_IMODE(path.lstat().st_mode),
            os.readlink(str(path)) if path.is_symlink() else path.read_bytes() if path.is_file() else None)
            for path in folder.rglob("*")}


def refused(path, *words, call=patches.apply, **options):
    before = snapshot(path)
    with pytest.raises(patches.PatchError) as caught:
        call(path, **options)
    assert snapshot(path) == before
    for word in words:
        assert word in str(caught.value), str(caught.value)


def test_only_the_statements_change(tmp_path):
    """Comments, blanks, the unusual colons and the missing last newline are where they were."""
    make(tmp_path)
    assert patches.check(tmp_path) == "patchable" and patches.check(tmp_path).trainer == "3dgs-2023"
    patches.apply(tmp_path)
    for name, text in PATCHED.items():
        assert (tmp_path / name).read_text() == text, name
    assert patches.check(tmp_path) == "patched"


@pytest.mark.parametrize("form", ["crlf", "bom", "latin-1", "tabs"])
def test_every_form_of_text_comes_back(tmp_path, form):
    encoded = {"crlf": lambda text: text.replace("\n", "\r\n").encode(), "bom": lambda text: text.encode("utf-8-sig"),
               "latin-1": lambda text: ("# -*- coding: latin-1 -*-\n# \xe9t\xe9\n" + text).encode("latin-1"),
               "tabs": lambda text: text.replace("    ", "\t").encode()}[form]
    make(tmp_path, {name: encoded(text) for name, text in CHECKOUT.items()})
    before = snapshot(tmp_path)
    patches.apply(tmp_path)
    if form in ("crlf", "bom"):  # then every line of ours is of the same form
        assert (tmp_path / "train.py").read_bytes() == encoded(PATCHED["train.py"])
        assert (tmp_path / ARGS).read_bytes() == encoded(PATCHED[ARGS])
    if form == "latin-1":
        assert (tmp_path / "train.py").read_bytes() == encoded(PATCHED["train.py"])
    if form == "tabs":
        assert b"\n\tpipe.blend = blend_of(dataset)\n" in (tmp_path / "train.py").read_bytes()
    for name in CHECKOUT:
        compile((tmp_path / name).read_bytes(), name, "exec")
    patches.revert(tmp_path)
    assert snapshot(tmp_path) == before


def test_applying_twice_writes_nothing(tmp_path):
    patches.apply(make(tmp_path))
    before = snapshot(tmp_path)
    assert not patches.apply(tmp_path).written
    assert snapshot(tmp_path) == before


def test_the_diff_is_the_same_before_and_after(tmp_path):
    make(tmp_path)
    before, text = snapshot(tmp_path), patches.diff(tmp_path)
    assert snapshot(tmp_path) == before
    assert "+    pipe.blend = blend_of(dataset)\n" in text and "No newline at end of file" in text
    patches.apply(tmp_path)
    assert patches.diff(tmp_path) == text


def test_modernise_may_be_added_to_a_patch(tmp_path):
    make(tmp_path)
    before = snapshot(tmp_path)
    patches.apply(tmp_path)
    assert patches.apply(tmp_path, modernise=True).written
    assert "torch.load(checkpoint, weights_only=False)" in (tmp_path / "train.py").read_text()
    assert not patches.apply(tmp_path).written  # the patch that is there has all of it
    patches.revert(tmp_path)
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize("name, old, new, rule, count", [
    (GR, "debug=pipe.debug", "debug=False", "settings-blend-mode", 0),
    (GR, "debug=pipe.debug", "debug=other.debug", "settings-blend-mode", 0),
    (GR, "image_height=camera.height", "camera.height", "settings-blend-mode", 0),
    (GR, "# slow\n    )\n", "# slow\n    )\n    settings = "
     "GaussianRasterizationSettings(image_height=1, debug=pipe.debug)\n", "settings-blend-mode", 2),
    (GR, "\n\ndef render(", "from diff_gaussian_rasterization import "
     "rasterize_gaussians\n\n\ndef render(", "import-rasterizer", 2),
    (ARGS, "class ModelParams", "class SceneParams", "model-parameter", 0),
    (ARGS, "super().__init__(parser, \"Loading", "ParamGroup.__init__(self, parser, \"Loading",
     "model-parameter", 0),
    ("train.py", "def training(dataset", "def training(scene", "pipe-blend-mode", 0),
    ("train.py", "def training(", "def fit(", "pipe-blend-mode", 0),
    ("render.py", "pipeline : object", "args : object", "pipe-blend-mode", 0),
])
def test_drift_is_refused_by_file_and_rule(tmp_path, name, old, new, rule, count):
    assert CHECKOUT[name].count(old) == 1
    make(tmp_path, {name: CHECKOUT[name].replace(old, new)})
    refused(tmp_path, name, rule, f"{count} matches instead of 1")
    verdict = patches.check(tmp_path)
    assert verdict == "drifted" and any(name in reason and rule in reason for reason in verdict.reasons)


def test_a_missing_or_broken_file_is_refused(tmp_path):
    refused(make(tmp_path / "missing", {"render.py": None}), "render.py", "pipe-blend-mode", "no such file")
    refused(make(tmp_path / "broken", {"train.py": TRAIN + "def\n"}), "train.py", "line 11")


def test_what_is_no_trainer_is_unknown(tmp_path):
    other = make(tmp_path / "other", {GR: RENDERER.replace("bg=bg_color", "kernel_size=0.1")})
    assert patches.check(other) == "unknown"
    refused(other, "kernel_size")
    refused(make(tmp_path / "none", {GR: "def render():\n    pass\n"}), "unknown")
    refused(make(tmp_path / "chosen"), "no trainer 'x'", *patches.TRAINERS, trainer="x")
    with pytest.raises(patches.PatchError, match="not a folder"):
        patches.apply(tmp_path / "nowhere")


def test_a_folder_beside_the_checkout_is_said_to_be_none(tmp_path):
    checkout = make(tmp_path / "checkout")
    (tmp_path / "else").mkdir()
    for folder in (tmp_path, checkout / "arguments"):
        refused(folder, "unknown", f"there is no {GR} in {folder}", f"such as {checkout}")
        refused(folder, f"there is no {GR} in {folder}", trainer="3dgs-2023")
    refused(tmp_path / "else", f"there is no {GR} in {tmp_path / 'else'}")


def test_a_trainer_that_it_does_not_look_like_is_warned_of(tmp_path):
    antialiasing = {GR: RENDERER.replace("prefiltered", "antialiasing")}
    (note,) = patches.plan(make(tmp_path / "2024", antialiasing), trainer="3dgs-2023").notes
    assert "--trainer 3dgs-2023" in note and "3dgs-2024" in note and "another API" in note
    assert patches.plan(make(tmp_path / "2023"), trainer="3dgs-2023").notes == ()
    patches.apply(tmp_path / "2024", trainer="3dgs-2023")
    assert patches.plan(tmp_path / "2024").notes == ()  # it was said when it was chosen


def test_a_patch_by_hand_is_half_or_whole(tmp_path):
    whole = make(tmp_path / "whole", PATCHED)
    assert patches.check(whole) == "patched"
    assert not patches.apply(whole).written
    refused(whole, ".dsmoe_patch", call=patches.revert)
    half = make(tmp_path / "half", {**PATCHED, "train.py": TRAIN})
    assert patches.check(half) == "half-patched"
    refused(half, "train.py: rule pipe-blend-mode: is not applied", "render.py: rule pipe-blend-mode: is applied")


@pytest.mark.parametrize("until", range(1, 17))
def test_an_interruption_leaves_what_can_be_finished_or_put_back(tmp_path, monkeypatch, until):
    """The power fails before the n-th file is in its place."""
    make(tmp_path)
    original = snapshot(tmp_path)
    finished = make(tmp_path.parent / f"finished{until}")
    patches.apply(finished)
    written = []

    def failing(root, path, data, replace=record_module.replace_file):
        written.append(path)
        if len(written) >= until:
            raise KeyboardInterrupt
        replace(root, path, data)

    for module in (record_module, engine):
        monkeypatch.setattr(module, "replace_file", failing)
    try:
        patches.apply(tmp_path)
    except KeyboardInterrupt:
        pass
    monkeypatch.undo()
    changed = [name for name in CHECKOUT if (tmp_path / name).read_bytes() != original[name][1]]
    state = "patched" if len(changed) == 4 else "half-patched" if until > 10 else "patchable"
    assert patches.check(tmp_path) == state
    if until > 10:  # the record is complete
        other = tmp_path.parent / f"reverted{until}"
        os.rename(str(tmp_path), str(other))
        if until % 2:
            patches.revert(other)
            assert snapshot(other) == original
        else:
            patches.apply(other)
            assert snapshot(other) == snapshot(finished)
    else:
        assert changed == []
        patches.apply(tmp_path)
        assert snapshot(tmp_path) == snapshot(finished)


def test_a_disk_that_is_full_changes_nothing(tmp_path, monkeypatch):
    make(tmp_path)
    before = snapshot(tmp_path)

    def failing(root, path, data, replace=record_module.replace_file):
        if path == tmp_path / "train.py" and b"blend_of" in data:
            raise OSError(28, "No space left on device")
        replace(root, path, data)

    monkeypatch.setattr(engine, "replace_file", failing)
    with pytest.raises(patches.PatchError, match="train.py: cannot be written, so all was put back"):
        patches.apply(tmp_path)
    assert snapshot(tmp_path) == before


def test_a_file_that_changed_since_is_not_overwritten(tmp_path):
    patches.apply(make(tmp_path))
    with open(str(tmp_path / "train.py"), "a") as file:
        file.write("# mine\n")
    verdict = patches.check(tmp_path)  # every rule is applied
    assert verdict == "patched" and verdict.reasons[1].startswith("train.py: was edited since")
    assert not patches.apply(tmp_path).written
    refused(tmp_path, "train.py", "changed", modernise=True)
    (tmp_path / "train.py").write_text(TRAIN + "# mine\n")  # the edit is kept, the patch is not
    refused(tmp_path, "train.py", "changed")


def test_revert_keeps_edits_of_other_lines_than_the_patchs(tmp_path):
    """Beside the patch's lines too."""
    before = snapshot(make(tmp_path))
    patches.apply(tmp_path)
    edits = [("import torch\n", "import os\nimport torch\n"), ("first_iter = 0\n", "first_iter = 1\n"),
             ("    # the first iteration is 1\n", "    print(dataset)\n"),
             ("first_iter\n", "first_iter\n\n\nprint()\n")]
    text, mine = (tmp_path / "train.py").read_text(), TRAIN
    for old, new in edits:
        text, mine = new.join(text.rsplit(old, 1)), new.join(mine.rsplit(old, 1))
    (tmp_path / "train.py").write_text(text)
    names = patches.revert(tmp_path)
    assert names.edited == ("train.py",) and set(names) == set(PATCHED)
    assert snapshot(tmp_path) == {**before, "train.py": (before["train.py"][0], mine.encode())}


def test_an_edit_of_the_patchs_own_lines_is_shown(tmp_path):
    patches.apply(make(tmp_path))
    train, text = tmp_path / "train.py", (tmp_path / "train.py").read_text()
    train.write_text(text.replace("blend_of(dataset)", "blend_of(other)"))
    refused(tmp_path, "train.py: line 7: ", "nothing was touched", "\n  -    pipe.blend = blend_of(dataset)",
            "\n  +    pipe.blend = blend_of(other)", call=patches.revert)
    train.write_text(text.replace("    pipe.blend", "    if 1:\n        pipe.blend"))
    refused(tmp_path, "train.py: line 7: ", call=patches.revert)
    train.write_text(text.replace("    pipe.blend", "    if 1:\n      \\\n    pipe.blend"))
    refused(tmp_path, "train.py: your edit needs statements of the patch", call=patches.revert)


def test_the_way_out_of_an_edit_is_the_one_that_is_named(tmp_path):
    """Where an earlier version, which kept no copy of the patched files, wrote the record."""
    original = snapshot(make(tmp_path))
    patches.apply(tmp_path)
    (tmp_path / "train.py").write_text((tmp_path / "train.py").read_text() + "# mine\n")
    shutil.rmtree(str(tmp_path / ".dsmoe_patch/patched"))
    with pytest.raises(patches.PatchError, match="copy what lies in .dsmoe_patch/originals over the checkout"):
        patches.revert(tmp_path)
    for copy in (tmp_path / ".dsmoe_patch/originals").rglob("*.py"):
        shutil.copy(str(copy), str(tmp_path / copy.relative_to(tmp_path / ".dsmoe_patch/originals")))
    shutil.rmtree(str(tmp_path / ".dsmoe_patch"))
    assert snapshot(tmp_path) == original


def test_a_patch_by_rules_of_before_is_known_and_brought_up_to_date(tmp_path):
    """Such as set `pipe.blend_mode` alone."""
    original = snapshot(make(tmp_path))
    former = {name: text.replace("**pipe.blend,", "blend_mode=pipe.blend_mode,").replace(".blend = ", ".blend_mode = ")
              for name, text in PATCHED.items()}
    record = record_module.Record.write(tmp_path, *({name: text.encode() for name, text in texts.items()}
                                                    for texts in (CHECKOUT, former)),
                                        {"version": "0", "trainer": "3dgs-2023", "options": []})
    make(tmp_path, former)
    record.completed()
    verdict = patches.check(tmp_path)
    assert verdict == "patched" and verdict.reasons[0] == "by version 0"
    assert f"to bring it up to date, type: dsmoe patch apply {tmp_path}" in verdict.reasons[1]
    assert patches.apply(tmp_path).written and not patches.apply(tmp_path).written
    assert all((tmp_path / name).read_text() == text for name, text in PATCHED.items())
    assert len(patches.check(tmp_path).reasons) == 1
    patches.revert(tmp_path)
    assert snapshot(tmp_path) == original


def another_commit(folder):
    """Replaces every file by that of a later version, as `git checkout` does."""
    for name, text in CHECKOUT.items():
        (folder / name).write_text("# a later version\n" + text)


@pytest.mark.parametrize("come_back", [make, another_commit])
def test_a_record_of_which_no_file_is_patched_any_more_is_no_hindrance(tmp_path, come_back):
    patches.apply(make(tmp_path / "checkout"))
    come_back(tmp_path / "checkout")
    shutil.copytree(str(tmp_path / "checkout"), str(tmp_path / "reverted"))
    verdict = patches.check(tmp_path / "checkout")
    assert verdict == "patchable" and "no file is patched any more" in verdict.reasons[0]
    assert prepared(tmp_path / "checkout")
    assert patches.apply(tmp_path / "checkout").written and patches.check(tmp_path / "checkout") == "patched"
    with pytest.raises(patches.PatchError, match="patched already"):
        prepared(tmp_path / "checkout")
    patches.revert(tmp_path / "checkout")
    assert patches.revert(tmp_path / "reverted") == ()
    assert snapshot(tmp_path / "checkout") == snapshot(tmp_path / "reverted")


def prepared(folder):
    from diff_smoe_rasterization.patches.run import prepare

    return prepare([sys.executable, str(folder / "train.py")], "smoe", None, dict(os.environ))


def test_what_is_patched_beside_replaced_files_is_put_back(tmp_path):
    """git replaces the trainer's files, and leaves those of its submodules."""
    setup = "submodules/grid/setup.py"
    make(tmp_path, {setup: "flags = ['-O2', '-std=c++14']\n"})
    patches.apply(tmp_path, modernise=True)
    another_commit(tmp_path)
    verdict = patches.check(tmp_path)
    assert verdict == "half-patched"
    assert any("train.py" in reason and "`revert`" in reason for reason in verdict.reasons)
    refused(tmp_path, "train.py")
    assert patches.revert(tmp_path) == (setup,)
    assert "c++14" in (tmp_path / setup).read_text() and "a later version" in (tmp_path / "train.py").read_text()
    assert patches.check(tmp_path) == "patchable" and not (tmp_path / ".dsmoe_patch").exists()


def test_a_damaged_record_is_no_ground_to_write(tmp_path):
    patches.apply(make(tmp_path))
    (tmp_path / ".dsmoe_patch/originals/train.py").write_text("something else")
    for call in (patches.apply, patches.revert, patches.check):
        refused(tmp_path, "manifest.json", "train.py", call=call)


def test_modes_links_and_blanks(tmp_path):
    folder = make(tmp_path / "a checkout with blanks")
    (folder / "train.py").chmod(0o755)
    (folder / "render.py").rename(folder / "render of mine.py")
    (folder / "render.py").symlink_to("render of mine.py")
    before = snapshot(folder)
    patches.apply(folder)
    after = snapshot(folder)
    assert after["train.py"][0] == 0o755 and after["render.py"] == before["render.py"]
    assert b"blend_of" in after["render of mine.py"][1]
    patches.revert(folder)
    assert snapshot(folder) == before


@pytest.mark.skipif(os.geteuid() != 0, reason="only root writes files that stay another user's")
def test_the_owner_stays(tmp_path):
    make(tmp_path)
    os.chown(str(tmp_path / "train.py"), 65534, 65534)
    for call in (patches.apply, patches.revert):
        call(tmp_path)
        owner = (tmp_path / "train.py").stat()
        assert (owner.st_uid, owner.st_gid) == (65534, 65534)


def test_what_may_not_be_written_is_refused(tmp_path):
    folder = make(tmp_path / "checkout")
    (folder / "train.py").chmod(0o444)
    refused(folder, "train.py", "read-only")
    (folder / "train.py").chmod(0o644)
    (folder / "render.py").rename(tmp_path / "render.py")
    (folder / "render.py").symlink_to(tmp_path / "render.py")
    refused(folder, "render.py", "outside the checkout")
    assert (tmp_path / "render.py").read_text() == RENDER


def test_scripts_of_the_user(tmp_path):
    """One that renders is named; one that imports the rasterizer gets the trainer's own."""
    folder = make(tmp_path, {"video.py": "from gaussian_renderer import render\n", "utils/score.py": "import math\n",
                             "film.py": "from gaussian_renderer import render\npipe.blend = {}\n",
                             "viewer.py": "from diff_gaussian_rasterization import GaussianRasterizer\n",
                             "python2.py": "print 'diff_gaussian_rasterization'\n",
                             "utils/loss.py": "try:\n    from diff_gaussian_rasterization._C import fusedssim\n"
                                              "except ImportError:\n    pass\n"})
    before = snapshot(folder)
    notes = patches.plan(folder).notes
    assert [note.partition(".py")[0] for note in notes] == ["left as it is: python2", "utils/loss", "video"]
    patches.apply(folder)
    assert "diff_smoe_rasterization.integrations.inria " in (folder / "viewer.py").read_text()
    assert snapshot(folder)["utils/loss.py"] == before["utils/loss.py"]


SCRIPTS = {
    "tools/own.py": ("from diff_gaussian_rasterization import GaussianRasterizer\n", "imports the original"),
    "tools/deep/own.py": ("from diff_gaussian_rasterization._C import mark_visible\n", "imports the original"),
    "whole.py": ("import diff_gaussian_rasterization as dgr\n", "imports the original"),
    "settings.py": ("from diff_gaussian_rasterization import GaussianRasterizationSettings\n"
                    "def show(pipe):\n    return GaussianRasterizationSettings(debug=pipe.debug)\n", "settings"),
    "film.py": ("import gaussian_renderer\ngaussian_renderer.render(None)\n", "renders"),
    "tools/film.py": ("from gaussian_renderer import render\n", "renders"),
    "all.py": ("from gaussian_renderer import *\n", "renders"),
}


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_that_keeps_the_original_or_has_no_mode_is_named(tmp_path, name):
    text, word = SCRIPTS[name]
    folder = make(tmp_path, {name: text})
    for _ in range(2):  # before the patch, and when it is there
        (note,) = patches.plan(folder).notes
        assert note.startswith(name + ": ") and word in note
        patches.apply(folder)


def test_what_is_no_script_of_the_checkout_is_not_named(tmp_path):
    """Environments, outputs with a copy of the code, other checkouts; what a script that is reached imports."""
    text = SCRIPTS["tools/film.py"][0]
    folder = make(tmp_path, {"env/pyvenv.cfg": "", "env/film.py": text, "out/cfg_args": "", "out/backup/film.py": text,
                             "submodules/a/film.py": text, ".cache/film.py": text, "lib/film.py": text,
                             "train.py": "from lib import film\n" + TRAIN, "tools/gui.py":
                             "from gaussian_renderer import network_gui\n", "tools/mode.py": "from gaussian_renderer "
                             "import render\npipe.blend = {}\n"})
    make(folder / "another")
    assert patches.plan(folder).notes == ()


def test_recognised_by_structure_alone():
    base = {"imports GaussianRasterizationSettings", "sets bg", "sets debug"}
    for name, signs in (("3dgs-2023", set()), ("3dgs-2024", {"sets antialiasing", "imports SparseGaussianAdam"}),
                        ("taming", {"sets pixel_weights", "imports SparseGaussianAdam"}),
                        ("c3dgs", {"sets clamp_color", "imports GaussianRasterizerIndexed"}),
                        ("hac", {"calls visible_filter", "imports encodings"}),
                        ("hac-plus", {"calls visible_filter", "imports gpcc_utils"}),
                        ("scaffold-gs", {"calls visible_filter", "imports lpips"})):
        assert facts.recognise(base | signs)[0].name == name
    assert facts.recognise({"sets bg"})[0] is None


@pytest.mark.skipif("DSMOE_TRAINERS" not in os.environ, reason="DSMOE_TRAINERS names no folder of public checkouts")
@pytest.mark.parametrize("name", patches.TRAINERS)
def test_in_public_checkouts_only_the_statements_change(name):
    """Densification, optimizers, losses: no line of them is touched."""
    folder = Path(os.environ["DSMOE_TRAINERS"]) / name
    if not folder.is_dir():
        pytest.skip(f"DSMOE_TRAINERS has no {name}")
    digest = hashlib.sha256(repr(sorted(snapshot(folder).items())).encode()).hexdigest()
    lines = [line for line in patches.diff(folder).splitlines() if line[0] in "+-" and line[:3] not in ("+++", "---")]
    removed = [line[1:].strip() for line in lines if line[0] == "-"]
    added = [line[1:].strip() for line in lines if line[0] == "+"]
    assert removed and all(line.startswith("from diff_gaussian_rasterization import") for line in removed)
    statements = ("from diff_smoe_rasterization.", "**pipe.blend,",
                  "self.blend_mode, self.background_gate = default_blend()", "pipe.blend = blend_of(dataset)",
                  "pipeline.blend = blend_of(dataset)", "pipeline_params.blend = blend_of(model_params)")
    assert all(line.startswith(statements) for line in added)
    assert digest == hashlib.sha256(repr(sorted(snapshot(folder).items())).encode()).hexdigest()


def test_modernise_is_refused_where_only_the_patch_is_there_and_no_record(tmp_path):
    checkout = make(tmp_path)
    patches.apply(checkout)
    shutil.rmtree(checkout / ".dsmoe_patch")
    before = snapshot(checkout)
    assert not patches.apply(checkout).written
    with pytest.raises(patches.PatchError, match="checkpoint-load is not applied"):
        patches.apply(checkout, modernise=True)
    assert snapshot(checkout) == before
