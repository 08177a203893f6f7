"""The engine of the patches: what is planned, written, kept and put back, and when not."""
from __future__ import annotations

import ast
import os
import shutil
from pathlib import Path

import pytest
from checkouts import RECORD, contents
from tiny import ARGS, CHECKOUT, GR, PATCHED, RENDER, TRAIN, make, refused

from diff_smoe_rasterization import patches
from diff_smoe_rasterization.patches import engine
from diff_smoe_rasterization.patches.record import Record

NOBODY = 65534


def test_only_the_statements_change(tmp_path):
    """Comments, blanks, the unusual colons and the missing last newline are where they were."""
    text = patches.diff(make(tmp_path))
    before = contents(tmp_path)
    assert "+    pipe.blend = blend_of(dataset)\n" in text and "No newline at end of file" in text
    assert patches.check(tmp_path)[1:3] == ("patchable", "3dgs-2023")
    assert patches.apply(tmp_path).written and not patches.apply(tmp_path).written
    for name, expected in PATCHED.items():
        assert (tmp_path / name).read_text() == expected, name
    assert patches.check(tmp_path).state == "patched" and patches.diff(tmp_path) == text
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


@pytest.mark.parametrize("body", [
    '    """Trains.\n\n    # see README"""\n', '    @functools.lru_cache\n    def first():\n        return 0\n'])
def test_a_line_is_put_before_a_statement_and_into_no_other(tmp_path, body):
    """Behind a docstring that looks like comments, and above what decorates the first statement."""
    text = TRAIN.replace("    # the first iteration is 1\n", body)
    make(tmp_path, {"train.py": text})
    patches.apply(tmp_path)
    function = next(node for node in ast.parse((tmp_path / "train.py").read_text()).body
                    if isinstance(node, ast.FunctionDef))
    assert any(ast.unparse(line) == "pipe.blend = blend_of(dataset)" for line in function.body)
    patches.revert(tmp_path)
    assert (tmp_path / "train.py").read_text() == text


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
    refused(make(tmp_path / "broken", {"train.py": TRAIN + "def\n"}), "train.py: is not Python", "line 11")
    refused(make(tmp_path / "none", {GR: "def render():\n    pass\n"}), "unknown", "nothing imports Gaussian")
    refused(make(tmp_path / "checkout"), "no trainer 'x'", *patches.TRAINERS, trainer="x")
    refused(tmp_path / "checkout", "hac", trainer="hac")
    refused(tmp_path / "checkout/arguments", f"there is no {GR} in", f"such as {tmp_path / 'checkout'}")
    with pytest.raises(patches.PatchError, match="not a folder"):
        patches.apply(tmp_path / "nowhere")


def test_a_patch_by_hand_is_half_or_whole(tmp_path):
    whole = make(tmp_path / "whole", PATCHED)
    assert patches.check(whole).state == "patched" and not patches.apply(whole).written
    refused(whole, ".dsmoe_patch", call=patches.revert)
    refused(whole, "checkpoint-load is not applied", modernise=True)
    half = make(tmp_path / "half", {**PATCHED, "train.py": TRAIN})
    refused(half, "train.py: rule pipe-blend-mode: is not applied", "render.py: rule pipe-blend-mode: is applied")
    refused(half, "there is no .dsmoe_patch", call=patches.revert)


class Killed(BaseException):
    """Nothing of the program runs after it."""


def failing_at(step, error, monkeypatch):
    """Raises an error within the step-th writing of a file, once; that file is empty then, or has its first half."""
    written, write = [], Path.write_bytes

    def counted(path, data):
        written.append(path)
        if len(written) == step:
            write(path, data[:len(data) // 2 * (step % 2)])
            raise error
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", counted)


# A record has two copies of each of four files; then the files are written.
@pytest.mark.parametrize("begin, options, step", [
    *((False, {}, step) for step in (1, 6, 9, 10, 12)), (True, {}, 2), (True, {}, 4), (True, {"modernise": True}, 1),
    (True, {"modernise": True}, 3), (True, {"modernise": True}, 8), (True, {"modernise": True}, 14)])
def test_a_kill_leaves_what_can_be_finished_or_put_back(tmp_path, monkeypatch, begin, options, step):
    checkout = make(tmp_path / "checkout")
    before = contents(checkout)
    if begin:
        patches.apply(checkout)
    with monkeypatch.context() as patch, pytest.raises(Killed):
        failing_at(step, Killed(), patch)
        patches.apply(checkout, **options) if options or not begin else patches.revert(checkout)
    finished = shutil.copytree(checkout, tmp_path / "finished")
    patches.apply(finished, **options)
    assert patches.check(finished).state == "patched" and not patches.apply(finished, **options).written
    for path in (checkout, finished):
        if contents(path) != before:
            patches.revert(path)
        assert contents(path) == before


@pytest.mark.parametrize("step", [1, 8, 10])
def test_a_full_disk_or_a_file_that_may_not_be_written_changes_nothing(tmp_path, monkeypatch, step):
    make(tmp_path)
    failing_at(step, OSError(28, "No space left on device"), monkeypatch)
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
    planned = patches.check(tmp_path)  # every rule is applied
    assert planned.state == "patched" and planned.reasons[1].startswith("train.py: was edited since")
    assert not patches.apply(tmp_path).written
    refused(tmp_path, "train.py: was changed since it was patched: undo your edit", modernise=True)
    files = patches.revert(tmp_path)
    assert set(files) == set(PATCHED) and [name for name, is_edited in files.items() if is_edited] == ["train.py"]
    assert contents(tmp_path) == {**before, "train.py": (before["train.py"][0], mine.encode())}


@pytest.mark.parametrize("old, new, words", [
    ("blend_of(dataset)", "blend_of(other)", [
        "train.py: you have edited what the patch wrote", "\n-    pipe.blend = blend_of(dataset)",
        "\n+    pipe.blend = blend_of(other)", "copy what lies in .dsmoe_patch/originals over the checkout"]),
    ("    pipe.blend", "    if 1:\n        pipe.blend", ["train.py: you have edited"]),
    ("    pipe.blend", "    if 1:\n      \\\n    pipe.blend", ["train.py: you have edited what the patch wrote, or"])])
def test_an_edit_of_the_patchs_own_lines_is_shown(tmp_path, old, new, words):
    patches.apply(make(tmp_path))
    (tmp_path / "train.py").write_text((tmp_path / "train.py").read_text().replace(old, new))
    refused(tmp_path, "nothing was touched", *words, call=patches.revert)


def test_a_patch_by_rules_of_before_is_known_and_brought_up_to_date(tmp_path):
    """Such as set `pipe.blend_mode` alone."""
    original = contents(make(tmp_path))
    former = {name: text.replace("**pipe.blend,", "blend_mode=pipe.blend_mode,").replace(".blend = ", ".blend_mode = ")
              for name, text in PATCHED.items()}
    Record.make(tmp_path, *({name: text.encode() for name, text in texts.items()} for texts in (CHECKOUT, former)),
                version="0", trainer="3dgs-2023", options=[])
    make(tmp_path, former)
    planned = patches.check(tmp_path)
    assert planned.state == "patched" and planned.reasons[0] == "by version 0"
    assert f"to bring it up to date, type: dsmoe patch apply {tmp_path}" in planned.reasons[1]
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
    planned = patches.check(checkout)
    assert planned.state == "patchable" and "no file is patched any more" in planned.reasons[0]
    assert patches.apply(checkout).written and patches.check(checkout).state == "patched"
    patches.revert(checkout)
    assert patches.revert(reverted) == {} and contents(checkout) == contents(reverted)


def test_what_is_patched_beside_replaced_files_is_put_back(tmp_path):
    """git replaces the trainer's files, and leaves those of its submodules."""
    setup = "submodules/grid/setup.py"
    make(tmp_path, {setup: "flags = ['-O2', '-std=c++14']\n"})
    patches.apply(tmp_path, modernise=True)
    assert (tmp_path / setup).read_text() == "flags = ['-O2']\n"
    another_commit(tmp_path)
    refused(tmp_path, "half-patched", "train.py: was changed since, and is not patched any more; `revert` leaves it")
    assert patches.revert(tmp_path) == {setup: False} and not (tmp_path / RECORD).exists()
    assert "c++14" in (tmp_path / setup).read_text() and "a later version" in (tmp_path / "train.py").read_text()


def test_a_file_that_was_restored_is_patched_again_and_one_that_was_removed_is_reported(tmp_path):
    patches.apply(make(tmp_path))
    (tmp_path / "train.py").write_text(TRAIN)
    planned = patches.check(tmp_path)
    assert planned.state == "half-patched" and planned.reasons[0].startswith("train.py: is not patched, or not any")
    assert patches.apply(tmp_path).written and patches.check(tmp_path).state == "patched"
    (tmp_path / "train.py").unlink()
    refused(tmp_path, "train.py: was removed since", call=patches.revert)


def test_a_damaged_record_is_no_ground_to_write(tmp_path):
    patches.apply(make(tmp_path))
    (tmp_path / RECORD / "originals/train.py").unlink()
    for call in (patches.apply, patches.revert, patches.check):
        refused(tmp_path, "manifest.json: the record of the patch is damaged", "has lost files", call=call)


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


def test_a_link_out_of_the_checkout_is_refused(tmp_path):
    folder = make(tmp_path / "checkout", {"render.py": None})
    (tmp_path / "render.py").write_text(RENDER)
    (folder / "render.py").symlink_to(tmp_path / "render.py")
    refused(folder, "render.py: is a link to", "outside the checkout")


SCRIPTS = {  # of the user's own: text, what is said of it
    "tools/own.py": ("from diff_gaussian_rasterization import GaussianRasterizer\n", "imports the original"),
    "tools/deep/own.py": ("from diff_gaussian_rasterization._C import mark_visible\n", "imports the original"),
    "whole.py": ("import diff_gaussian_rasterization as dgr\n", "imports the original"),
    "settings.py": ("from diff_gaussian_rasterization import GaussianRasterizationSettings\n"
                    "def show(pipe):\n    return GaussianRasterizationSettings(debug=pipe.debug)\n", "makes Gaussian"),
    "film.py": ("import gaussian_renderer\ngaussian_renderer.render(None)\n", "renders"),
    "tools/film.py": ("from gaussian_renderer import render\n", "pipe.blend = saved_blend_of(dataset)"),
    "fit.py": ("from gaussian_renderer import render\nrender(None).backward()\n", "pipe.blend = blend_of(dataset)"),
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
    tmp_path = make(tmp_path / "checkout", {**{name: text for name, (text, _) in SCRIPTS.items()},
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


def test_what_is_typed_wrongly_shows_the_usage(tmp_path, dsmoe):
    for words in (["patch", "apply"], ["patch", "revert"]):
        said = dsmoe(*words, tmp_path, "--modernize")
        assert said.status == 2 and f"usage: dsmoe {' '.join(words)} " in said.err and "--modernize" in said.err
    (make(tmp_path) / "film.py").write_bytes(b"import diff_gaussian_rasterization\n\0x")
    assert "film.py: is not Python that can be parsed: " in dsmoe("patch", "check", tmp_path).out


def test_the_readme_has_every_trainer_rule_and_state():
    from diff_smoe_rasterization.patches.rules import ON_REQUEST, rules_of
    from diff_smoe_rasterization.patches.trainers import TRAINERS

    text = (Path(__file__).resolve().parents[3] / "patches" / "README.md").read_text()
    cells = {line.split(" | ")[0].strip(" |`"): line for line in text.splitlines() if line.startswith("| `")}
    for trainer in TRAINERS:
        assert f"`{trainer.flavour}`" in cells[trainer.name]
        assert {rule.name for rule in rules_of(trainer)} <= set(cells)
        assert all(f"`{rule.function}`" in cells[trainer.name] for rule in trainer.entries)
    assert {rule.name for rules in ON_REQUEST.values() for rule in rules} <= set(cells)
    assert all(state in text for state in engine.STATES)
