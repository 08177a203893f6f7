"""The engine of the patches: what is planned, written, kept and put back, and when not."""
from __future__ import annotations

import functools
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path

import pytest

pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")

from checkouts import RECORD, changed_files, contents  # noqa: E402
from tiny import ARGS, CHECKOUT, GR, PATCHED, RENDER, TRAIN, make, refused  # noqa: E402

from diff_smoe_rasterization import patches  # noqa: E402
from diff_smoe_rasterization.patches import engine  # noqa: E402
from diff_smoe_rasterization.patches.record import Record  # noqa: E402

NOBODY = 65534


def test_only_the_statements_change(tmp_path):
    """Comments, blanks, the unusual colons and the missing last newline are where they were."""
    text = patches.diff(make(tmp_path))
    before = contents(tmp_path)
    assert "+    pipe.blend = blend_of(dataset)\n" in text and "No newline at end of file" in text
    assert patches.check(tmp_path) == "patchable" and patches.check(tmp_path).trainer == "3dgs-2023"
    assert patches.apply(tmp_path).written and not patches.apply(tmp_path).written
    for name, expected in PATCHED.items():
        assert (tmp_path / name).read_text() == expected, name
    assert patches.check(tmp_path) == "patched" and patches.diff(tmp_path) == text
    patches.revert(tmp_path)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("form", [
    lambda text: text.replace("\n", "\r\n").encode(), lambda text: text.encode("utf-8-sig"),
    lambda text: ("# -*- coding: latin-1 -*-\n# \xe9t\xe9\n" + text).encode("latin-1"),
    lambda text: text.replace("    ", "\t").encode(), lambda text: text.replace(":\n", ":  \n").encode() + b"  "])
def test_every_form_of_text_comes_back(tmp_path, form):
    before = contents(make(tmp_path, {name: form(text) for name, text in CHECKOUT.items()}))
    patches.apply(tmp_path)
    after = (tmp_path / "train.py").read_bytes()
    added = form(PATCHED["train.py"]) if b"  \n" not in after else after  # the patch's own lines have no blanks
    assert after == added and b"pipe.blend = blend_of(dataset)" in after
    patches.revert(tmp_path)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name, old, new, rule", [
    (GR, "debug=pipe.debug", "debug=False", "settings-blend-mode: 1 that look alike"),
    (GR, "debug=pipe.debug", "debug=other.debug", "settings-blend-mode: 1 that look alike"),
    (GR, "image_height=camera.height", "camera.height", "settings-blend-mode: 1 that look alike"),
    (GR, "# slow\n    )\n", "# slow\n    )\n    settings = GaussianRasterizationSettings(image_height=1)\n",
     "settings-blend-mode: 1 that look alike"),
    (ARGS, "class ModelParams", "class SceneParams", "model-parameter: no match"),
    (ARGS, 'super().__init__(parser, "Loading', 'ParamGroup.__init__(self, parser, "Loading',
     "model-parameter: no match"),
    ("train.py", "def training(dataset", "def training(scene", "pipe-blend-mode: no match"),
    ("render.py", "pipeline : object", "args : object", "pipe-blend-mode: no match")])
def test_drift_is_refused_by_file_and_rule(tmp_path, name, old, new, rule, dsmoe):
    assert CHECKOUT[name].count(old) == 1
    make(tmp_path, {name: CHECKOUT[name].replace(old, new)})
    refused(tmp_path, f"{name}: rule {rule}")
    said = dsmoe("patch", "check", tmp_path)
    assert said.status == 1 and ": drifted (3dgs-2023)" in said.out and f"{name}: rule {rule}" in said.err


def test_what_is_no_trainer_or_none_that_is_known_is_refused(tmp_path):
    refused(make(tmp_path / "missing", {"render.py": None}), "render.py: rule pipe-blend-mode: there is no such file")
    refused(make(tmp_path / "broken", {"train.py": TRAIN + "def\n"}), "train.py: is not Python", "11:1")
    refused(make(tmp_path / "none", {GR: "def render():\n    pass\n"}), "unknown", "nothing imports Gaussian")
    refused(make(tmp_path / "checkout"), "no trainer 'x'", *patches.TRAINERS, trainer="x")
    refused(tmp_path / "checkout", "hac", trainer="hac")
    refused(tmp_path / "checkout/arguments", f"there is no {GR} in", f"such as {tmp_path / 'checkout'}")
    with pytest.raises(patches.PatchError, match="not a folder"):
        patches.apply(tmp_path / "nowhere")


def test_a_patch_by_hand_is_half_or_whole(tmp_path):
    whole = make(tmp_path / "whole", PATCHED)
    assert patches.check(whole) == "patched" and not patches.apply(whole).written
    refused(whole, ".dsmoe_patch", call=patches.revert)
    refused(whole, "checkpoint-load is not applied", modernise=True)
    half = make(tmp_path / "half", {**PATCHED, "train.py": TRAIN})
    refused(half, "train.py: rule pipe-blend-mode: is not applied", "render.py: rule pipe-blend-mode: is applied")
    refused(half, "there is no .dsmoe_patch", call=patches.revert)


def in_a_fork(action):
    """Runs action in a copy of this process; returns 0, 1 where it raised, or minus the signal that ended it."""
    child = os.fork()
    if child == 0:
        try:
            action()
            os._exit(0)
        except BaseException as error:
            print(error, file=sys.stderr)
            os._exit(1)
    status = os.waitpid(child, 0)[1]
    return os.WEXITSTATUS(status) if os.WIFEXITED(status) else -os.WTERMSIG(status)


def killed_at(step, action):
    """Runs action in a fork that is killed before its `step`-th replacement of a file; returns whether it was."""
    def run():
        count, replace = [0], os.replace

        def counted(*arguments):
            if count[0] == step:
                os.kill(os.getpid(), signal.SIGKILL)
            count[0] += 1
            return replace(*arguments)

        os.replace = counted
        action()

    status = in_a_fork(run)
    assert status in (0, -signal.SIGKILL)
    return status != 0


@pytest.mark.parametrize("begin, action, interruptions", [
    (lambda path: None, patches.apply, 5), (patches.apply, patches.revert, 5),
    pytest.param(patches.apply, lambda path: patches.apply(path, modernise=True), 10, marks=pytest.mark.slow)])
def test_a_kill_leaves_what_can_be_finished_or_put_back(tmp_path, begin, action, interruptions):
    before = contents(make(tmp_path / "fresh"))
    whole = {True: None, False: None}
    for modernise in whole:
        patches.apply(shutil.copytree(tmp_path / "fresh", tmp_path / f"whole {modernise}"), modernise=modernise)
        whole[modernise] = contents(tmp_path / f"whole {modernise}", record=False)
    begin(shutil.copytree(tmp_path / "fresh", tmp_path / "begun"))
    for step in range(interruptions + 1):
        torn = shutil.copytree(tmp_path / "begun", tmp_path / f"torn {step}")
        assert killed_at(step, functools.partial(action, torn)) == (step < interruptions), step
        for file in changed_files(before, contents(torn, record=False)):
            assert (torn / file).read_bytes() in [files[file][1] for files in whole.values()], "neither old nor new"
        if step == interruptions:
            return
        finished = shutil.copytree(torn, tmp_path / f"finished {step}")
        patches.apply(finished)
        assert contents(finished, record=False) in whole.values()
        for path in (finished, torn):
            if contents(path) != before:
                patches.revert(path)
            assert contents(path) == before


@pytest.mark.parametrize("failing", ["train.py", RECORD])
def test_a_full_disk_changes_nothing(tmp_path, monkeypatch, failing):
    make(tmp_path)
    replace, calls = os.replace, []

    def full(source, target):
        calls.append(target)
        if str(target) == str(tmp_path / failing) and calls.count(target) == 1:
            raise OSError(28, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    refused(tmp_path, "cannot be written, so all was put back: [Errno 28]")


def test_options_are_added_to_a_patch_and_stay_with_it(tmp_path, dsmoe):
    before = contents(make(tmp_path, {"utils/loss_utils.py": "def ssim(img1, img2):\n    return 1\n"}))
    patches.apply(tmp_path)
    assert patches.apply(tmp_path, modernise=True).written
    assert "torch.load(checkpoint, weights_only=False)" in (tmp_path / "train.py").read_text()
    assert not patches.apply(tmp_path).written and ", with --modernise" in dsmoe("patch", "check", tmp_path).out
    assert patches.apply(tmp_path, fuse=True).options == ("modernise", "fuse")
    assert "@fused_where_equal\ndef ssim" in (tmp_path / "utils/loss_utils.py").read_text()
    patches.revert(tmp_path)
    assert contents(tmp_path) == before


def test_an_edit_is_neither_overwritten_nor_lost(tmp_path):
    """Beside the patch's lines too."""
    before = contents(make(tmp_path))
    patches.apply(tmp_path)
    text, mine = (tmp_path / "train.py").read_text(), TRAIN
    for old, new in (("import torch\n", "import os\nimport torch\n"), ("first_iter = 0\n", "first_iter = 1\n"),
                     ("    # the first iteration is 1\n", "    print(dataset)\n"),
                     ("first_iter\n", "first_iter\n\n\nprint()\n")):
        text, mine = new.join(text.rsplit(old, 1)), new.join(mine.rsplit(old, 1))
    (tmp_path / "train.py").write_text(text)
    verdict = patches.check(tmp_path)  # every rule is applied
    assert verdict == "patched" and verdict.reasons[1].startswith("train.py: was edited since")
    assert not patches.apply(tmp_path).written
    refused(tmp_path, "train.py: was changed since it was patched: undo your edit", modernise=True)
    names = patches.revert(tmp_path)
    assert names.edited == ("train.py",) and set(names) == set(PATCHED)
    assert contents(tmp_path) == {**before, "train.py": (before["train.py"][0], mine.encode())}


@pytest.mark.parametrize("old, new, words", [
    ("blend_of(dataset)", "blend_of(other)", [
        "train.py: you have edited what the patch wrote", "\n  -    pipe.blend = blend_of(dataset)",
        "\n  +    pipe.blend = blend_of(other)"]),
    ("    pipe.blend", "    if 1:\n        pipe.blend", ["train.py: you have edited"]),
    ("    pipe.blend", "    if 1:\n      \\\n    pipe.blend", ["train.py: your edit needs statements of the patch"])])
def test_an_edit_of_the_patchs_own_lines_is_shown(tmp_path, old, new, words):
    patches.apply(make(tmp_path))
    (tmp_path / "train.py").write_text((tmp_path / "train.py").read_text().replace(old, new))
    refused(tmp_path, "nothing was touched", *words, call=patches.revert)


def test_the_way_out_of_an_edit_is_the_one_that_is_named(tmp_path):
    """Where the record has no copy of the patched file, by which edits could be told apart."""
    original = contents(make(tmp_path))
    patches.apply(tmp_path)
    (tmp_path / "train.py").write_text((tmp_path / "train.py").read_text() + "# mine\n")
    shutil.rmtree(tmp_path / RECORD / "patched")
    refused(tmp_path, "copy what lies in .dsmoe_patch/originals over the checkout", call=patches.revert)
    shutil.copytree(tmp_path / RECORD / "originals", tmp_path, dirs_exist_ok=True)
    shutil.rmtree(tmp_path / RECORD)
    assert contents(tmp_path) == original


def test_a_patch_by_rules_of_before_is_known_and_brought_up_to_date(tmp_path):
    """Such as set `pipe.blend_mode` alone."""
    original = contents(make(tmp_path))
    former = {name: text.replace("**pipe.blend,", "blend_mode=pipe.blend_mode,").replace(".blend = ", ".blend_mode = ")
              for name, text in PATCHED.items()}
    Record.make(tmp_path, *({name: text.encode() for name, text in texts.items()} for texts in (CHECKOUT, former)),
                {"version": "0", "trainer": "3dgs-2023", "options": []})
    make(tmp_path, former)
    verdict = patches.check(tmp_path)
    assert verdict == "patched" and verdict.reasons[0] == "by version 0"
    assert f"to bring it up to date, type: dsmoe patch apply {tmp_path}" in verdict.reasons[1]
    assert patches.apply(tmp_path).written and not patches.apply(tmp_path).written
    assert all((tmp_path / name).read_text() == text for name, text in PATCHED.items())
    patches.revert(tmp_path)
    assert contents(tmp_path) == original


def another_commit(folder):
    """Replaces every file by that of a later version, as `git checkout` does."""
    for name, text in CHECKOUT.items():
        (folder / name).write_text("# a later version\n" + text)


@pytest.mark.parametrize("come_back", [make, another_commit])
def test_a_record_of_which_no_file_is_patched_any_more_is_no_hindrance(tmp_path, come_back):
    checkout, reverted = make(tmp_path / "checkout"), tmp_path / "reverted"
    patches.apply(checkout)
    come_back(checkout)
    shutil.copytree(checkout, reverted)
    verdict = patches.check(checkout)
    assert verdict == "patchable" and "no file is patched any more" in verdict.reasons[0]
    assert patches.apply(checkout).written and patches.check(checkout) == "patched"
    patches.revert(checkout)
    assert patches.revert(reverted) == () and contents(checkout) == contents(reverted)


def test_what_is_patched_beside_replaced_files_is_put_back(tmp_path):
    """git replaces the trainer's files, and leaves those of its submodules."""
    setup = "submodules/grid/setup.py"
    make(tmp_path, {setup: "flags = ['-O2', '-std=c++14']\n"})
    patches.apply(tmp_path, modernise=True)
    assert (tmp_path / setup).read_text() == "flags = ['-O2']\n"
    another_commit(tmp_path)
    refused(tmp_path, "half-patched", "train.py: was changed since, and is not patched any more; `revert` leaves it")
    assert patches.revert(tmp_path) == (setup,) and not (tmp_path / RECORD).exists()
    assert "c++14" in (tmp_path / setup).read_text() and "a later version" in (tmp_path / "train.py").read_text()


def test_a_file_that_was_restored_is_patched_again_and_one_that_was_removed_is_reported(tmp_path):
    patches.apply(make(tmp_path))
    (tmp_path / "train.py").write_text(TRAIN)
    verdict = patches.check(tmp_path)
    assert verdict == "half-patched" and verdict.reasons[0].startswith("train.py: is not patched, or not any more")
    assert patches.apply(tmp_path).written and patches.check(tmp_path) == "patched"
    (tmp_path / "train.py").unlink()
    refused(tmp_path, "train.py: was removed since", call=patches.revert)


def test_a_damaged_record_is_no_ground_to_write(tmp_path):
    patches.apply(make(tmp_path))
    (tmp_path / RECORD / "originals/train.py").write_text("something else")
    for call in (patches.apply, patches.revert, patches.check):
        refused(tmp_path, "manifest.json", "the original of train.py", call=call)


def test_modes_owners_and_links_stay(tmp_path):
    folder = make(tmp_path / "a checkout with blanks")
    (folder / "train.py").chmod(0o755)
    if os.geteuid() == 0:
        os.chown(folder / "train.py", NOBODY, NOBODY)
    (folder / "render.py").rename(folder / "render of mine.py")
    (folder / "render.py").symlink_to("render of mine.py")
    before, owner = contents(folder), (folder / "train.py").stat().st_uid
    patches.apply(folder)
    after = contents(folder)
    assert after["train.py"][0] == 0o755 and (folder / "train.py").stat().st_uid == owner
    assert after["render.py"] == before["render.py"] and b"blend_of" in after["render of mine.py"][1]
    patches.revert(folder.rename(tmp_path / "moved"))
    assert contents(tmp_path / "moved") == before


@pytest.mark.parametrize("locked, word", [
    ("gaussian_renderer", "gaussian_renderer is read-only"), ("render.py", "render.py: is read-only"),
    (".", "is read-only; make it writable first")])
def test_what_may_not_be_written_is_refused(locked, word):
    """In a folder that `nobody` can reach, who root becomes: nothing is read-only for root."""
    with tempfile.TemporaryDirectory() as above:
        os.chmod(above, 0o755)
        checkout = make(Path(above) / "checkout")
        for path in (checkout, *checkout.rglob("*")) if os.geteuid() == 0 else ():
            os.chown(path, NOBODY, NOBODY)
        (checkout / locked).chmod(0o555)

        def apply():
            if os.geteuid() == 0:
                os.setuid(NOBODY)
            refused(checkout, word)

        assert in_a_fork(apply) == 0
        (checkout / locked).chmod(0o755)


def test_a_link_out_of_the_checkout_is_refused(tmp_path):
    folder = make(tmp_path / "checkout", {"render.py": None})
    (tmp_path / "render.py").write_text(RENDER)
    (folder / "render.py").symlink_to(tmp_path / "render.py")
    refused(folder, "render.py: is a link to", "outside the checkout")


SCRIPTS = {  # of the user's own: text, what is said of it
    "../refine/model.py": ("from diff_gaussian_rasterization import GaussianRasterizer\n", "imports the original"),
    "tools/own.py": ("from diff_gaussian_rasterization import GaussianRasterizer\n", "imports the original"),
    "tools/deep/own.py": ("from diff_gaussian_rasterization._C import mark_visible\n", "imports the original"),
    "whole.py": ("import diff_gaussian_rasterization as dgr\n", "imports the original"),
    "settings.py": ("from diff_gaussian_rasterization import GaussianRasterizationSettings\n"
                    "def show(pipe):\n    return GaussianRasterizationSettings(debug=pipe.debug)\n", "makes Gaussian"),
    "film.py": ("import gaussian_renderer\ngaussian_renderer.render(None)\n", "renders"),
    "tools/film.py": ("from gaussian_renderer import render\n", "renders"),
    "all.py": ("from gaussian_renderer import *\n", "renders"),
    "utils/loss.py": ("try:\n    from diff_gaussian_rasterization._C import fusedssim\nexcept ImportError: 0\n",
                      "stays"),
    "viewer.py": ("from diff_gaussian_rasterization import GaussianRasterizer\n", None),  # a rule changes it
    "mode.py": ("from gaussian_renderer import render\npipe.blend = {}\n", None),
    "gui.py": ("from gaussian_renderer import network_gui\n", None),
    "out/backup/film.py": ("from gaussian_renderer import render\n", None),
    "env/film.py": ("from gaussian_renderer import render\n", None), "out/cfg_args": ("", None),
    "env/pyvenv.cfg": ("", None), ".cache/film.py": ("from gaussian_renderer import render\n", None),
    "lib/film.py": ("from gaussian_renderer import render\n", None)}  # train.py imports it


def test_scripts_that_keep_the_original_or_have_no_mode_are_named(tmp_path):
    tmp_path = make(tmp_path / "bundled", {**{name: text for name, (text, _) in SCRIPTS.items()},
                                           "train.py": "from lib import film\n" + TRAIN})
    for _ in range(2):  # before the patch, and when it is there
        notes = {note.partition(": ")[0]: note for note in patches.plan(tmp_path).notes}
        assert set(notes) == {name for name, (_, word) in SCRIPTS.items() if word}
        assert all(SCRIPTS[name][1] in note for name, note in notes.items())
        patches.apply(tmp_path)
    assert "diff_smoe_rasterization.integrations.inria " in (tmp_path / "viewer.py").read_text()


LOAD = "checkpoint = torch.load(path)\n"


def test_check_says_what_is_applied(tmp_path, dsmoe):
    checkout = make(tmp_path / "a checkout", {"utils/loading.py": LOAD})
    said = dsmoe("patch", "apply", checkout, "--dry-run")
    assert said.status == 0 and said.out == patches.diff(checkout)
    said = dsmoe("patch", "apply", checkout)
    assert said.status == 0 and "train.py: pipe-blend-mode" in said.out
    assert "already patched" in dsmoe("patch", "apply", checkout).out
    said = dsmoe("patch", "check", checkout, "--modernise")
    assert "modernise checkpoint-load: not applied in train.py, utils/loading.py: torch 2.6" in said.out
    assert dsmoe("patch", "apply", "--modernise", checkout).status == 0
    said = dsmoe("patch", "check", checkout)
    assert "modernise checkpoint-load: applied in train.py, utils/loading.py: torch 2.6" in said.out
    assert "not applied" not in said.out
    shutil.rmtree(checkout / RECORD)
    said = dsmoe("patch", "diff", checkout)
    assert said.status == 0 and "not known without .dsmoe_patch" in said.err


def test_what_is_typed_wrongly_shows_the_usage(tmp_path, dsmoe, monkeypatch):
    for words in (["patch", "apply"], ["patch", "revert"]):
        said = dsmoe(*words, tmp_path, "--modernize")
        assert said.status == 2 and f"usage: dsmoe {' '.join(words)} " in said.err and "--modernize" in said.err
    (make(tmp_path) / "film.py").write_bytes(b"import diff_gaussian_rasterization\n\0x")
    assert "film.py: is not Python that can be parsed: " in dsmoe("patch", "check", tmp_path).out
    monkeypatch.setitem(sys.modules, "libcst", None)  # an import of it fails
    said = dsmoe("patch", "apply", tmp_path)
    assert said.status == 1 and "pip install libcst" in said.err


def test_the_readme_has_every_trainer_rule_and_state():
    from diff_smoe_rasterization.patches.optional import OPTIONS
    from diff_smoe_rasterization.patches.patch import rules_of
    from diff_smoe_rasterization.patches.trainers import TRAINERS

    text = (Path(__file__).resolve().parents[3] / "patches" / "README.md").read_text()
    cells = {line.split(" | ")[0].strip(" |`"): line for line in text.splitlines() if line.startswith("| `")}
    for trainer in TRAINERS:
        assert f"`{trainer.flavour}`" in cells[trainer.name]
        assert {rule.name for rule in rules_of(trainer)} <= set(cells)
        assert all(f"`{rule.function}`" in cells[trainer.name] for rule in trainer.entries)
    assert {rule.name for rules in OPTIONS.values() for rule in rules} <= set(cells)
    assert all(state in text for state in engine.STATES)
