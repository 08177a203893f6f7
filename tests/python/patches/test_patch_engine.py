"""The engine of the patches: what is planned, written and taken back, and when not."""
from __future__ import annotations

import ast
import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest
import unprivileged
from checkouts import ARGS, CHECKOUT, GR, PATCHED, RENDER, RENDERER, TRAIN, contents, digest, make, marked, refused

from dsmoe import patches
from dsmoe.patches import engine

NOBODY = 65534


def test_only_the_statements_change(tmp_path):
    """Comments, blanks, the unusual colons and the missing last newline are where they were. A copy can be reverted."""
    checkout, copy = make(tmp_path / "checkout"), tmp_path / "copy"
    text, before = patches.diff(checkout), contents(checkout)
    assert "+    " + marked("pipe.blend = blend_of(dataset)") in text and "No newline at end of file" in text
    assert patches.check(checkout)[1:3] == ("patchable", "3dgs-2023")
    assert patches.apply(checkout).written and not patches.apply(checkout).written
    for name, expected in PATCHED.items():
        assert (checkout / name).read_text() == expected, name
    assert patches.check(checkout).state == "patched" and patches.diff(checkout) == text
    for folder in (shutil.copytree(checkout, copy), checkout):
        patches.revert(folder)
        assert contents(folder) == before
    refused(checkout, "no file has a line of a patch", call=patches.revert)


@pytest.mark.parametrize("form", [
    lambda text: text.replace("\n", "\r\n").encode(), lambda text: text.encode("utf-8-sig"),
    lambda text: ("# -*- coding: latin-1 -*-\n# \xe9t\xe9\n" + text).encode("latin-1"),
    lambda text: text.replace("    ", "\t").encode(), lambda text: text.replace(":\n", ":  \n").encode() + b"  "])
def test_every_form_of_text_comes_back(tmp_path, form):
    before = contents(make(tmp_path, {name: form(text) for name, text in CHECKOUT.items()}))
    patches.apply(tmp_path)
    assert {name: (tmp_path / name).read_bytes() for name in PATCHED} == {
        name: form(text) for name, text in PATCHED.items()}
    patches.revert(tmp_path)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("old, new", [
    ("    # the first iteration is 1\n", '    """Trains.\n\n    # see README"""\n'),
    ("    # the first iteration is 1\n", "    @functools.lru_cache\n    def first():\n        return 0\n"),
    ("import torch", '"""Trains."""\nfrom __future__ import annotations\nimport torch')])
def test_a_line_is_put_before_a_statement_and_into_no_other(tmp_path, old, new):
    """Behind a docstring that looks like comments, above what decorates the first statement, behind __future__."""
    text = TRAIN.replace(old, new)
    make(tmp_path, {"train.py": text})
    patches.apply(tmp_path)
    tree = ast.parse((tmp_path / "train.py").read_text())
    compile(tree, "train.py", "exec")
    function = next(node for node in tree.body if isinstance(node, ast.FunctionDef))
    assert any(isinstance(line, ast.Assign) and getattr(line.targets[0], "attr", "") == "blend"
               for line in function.body[:2])
    patches.revert(tmp_path)
    assert (tmp_path / "train.py").read_text() == text


def test_settings_in_one_line_and_imports_in_a_try_come_back(tmp_path):
    text = RENDERER.replace(RENDERER[RENDERER.index("(\n        image"):RENDERER.index("    return")],
                            "(image_height=(camera.height), debug=pipe.debug)\n")
    text = text.replace("from diff", "try:\n    from  diff").replace("Rasterizer\n", "Rasterizer\nexcept: 0\n", 1)
    make(tmp_path, {GR: text})
    patches.apply(tmp_path)
    after = (tmp_path / GR).read_text()
    compile(after, GR, "exec")
    assert f"Settings({marked('**chosen_blend(pipe),')}        image_height=(" in after
    patches.revert(tmp_path)
    assert (tmp_path / GR).read_text() == text


@pytest.mark.parametrize("name, old, new, rule", [
    (GR, "debug=pipe.debug", "debug=False", "settings-blend-mode: the call in line"),
    (GR, "image_height=camera", "image_height=\\\ncamera", "settings-blend-mode: the call in line"),
    (GR, "image_height=camera.height", "camera.height", "settings-blend-mode: the call in line"),
    (GR, "# slow\n    )\n", "# slow\n    )\n    settings = GaussianRasterizationSettings(image_height=1)\n",
     "settings-blend-mode: the call in line"),
    ("train.py", "checkpoint):\n    # the first iteration is 1\n    first_iter = 0\n    if checkpoint:",
     "checkpoint): 0; checkpoint = 1\nif 1:\n    if checkpoint:", "pipe-blend-mode: line 5 has more than one"),
    (GR, "debug=pipe.debug", "debug=pipe['debug']", "settings-blend-mode: the call in line"),
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
    assert said.status == 1 and ": unpatchable (3dgs-2023)" in said.out and f"{name}: rule {rule}" in said.out


def test_what_is_no_trainer_or_none_that_is_known_is_refused(tmp_path):
    refused(make(tmp_path / "missing", {"train.py": None}), "train.py: rule pipe-blend-mode: there is no such file")
    refused(make(tmp_path / "broken", {"train.py": TRAIN + "def\n"}), "train.py: rule pipe-blend-mode: is not Python",
            "(line 11)")
    refused(make(tmp_path / "none", {GR: "def render():\n    pass\n"}), "unknown", "nothing imports Gaussian",
            "name the folder in which train.py lies")
    refused(make(tmp_path / "checkout"), "no trainer 'x'", *patches.TRAINERS, trainer="x")
    refused(tmp_path / "checkout", "hac", trainer="hac")
    refused(tmp_path / "checkout/gaussian_renderer", f"there is no {GR} in it", "the folder in which train.py lies")
    refused(make(tmp_path / "own", {**dict.fromkeys(CHECKOUT), "dsmoe/cli.py": "", "tests/train.py": TRAIN}),
            "this package's own, and no trainer's; name the folder")
    refused(tmp_path, "in broken, checkout, missing", "and others: name one of these")
    with pytest.raises(patches.PatchError, match="not a folder"):
        patches.apply(tmp_path / "nowhere")
    for broken in ("missing", "broken"):
        assert not any("dsmoe run" in line for line in patches.check(tmp_path / broken).reasons)


def test_an_empty_path_is_not_the_current_folder(tmp_path, monkeypatch, dsmoe):
    """As of a variable that is unset: `dsmoe patch apply "$TRAINER"`."""
    monkeypatch.chdir(make(tmp_path))
    for call in (patches.apply, patches.check, patches.diff, patches.revert):
        with pytest.raises(patches.PatchError, match="the path is empty; name the checkout's folder"):
            call("")
        said = dsmoe("patch", call.__name__, "")
        assert said.status == 2 and "is empty" in said.err
    assert patches.check(".").state == "patchable"


class Killed(BaseException):
    """Nothing of the program runs after it."""


def failing_at(step, error, monkeypatch):
    """Raises an error at the step-th writing or replacing of a file, once; what was being written is cut then."""
    done, write, replace, remove = [], Path.write_bytes, os.replace, shutil.rmtree

    def counted(act, *arguments):
        done.append(arguments)
        if len(done) != step:
            return act(*arguments)
        if act is write:
            write(arguments[0], arguments[1][:len(arguments[1]) // 2])
        raise error

    monkeypatch.setattr(Path, "write_bytes", lambda *arguments: counted(write, *arguments))
    monkeypatch.setattr(os, "replace", lambda *arguments: counted(replace, *arguments))
    monkeypatch.setattr(shutil, "rmtree", lambda *arguments, **more: (
        None if isinstance(error, Killed) and len(done) >= step else remove(*arguments, **more)))


# Four files are written, then each takes its place.
@pytest.mark.parametrize("begin, options, step", [
    *((False, {}, step) for step in (1, 4, 5, 8)), (True, {}, 2), (True, {}, 6), (True, {"fuse": True}, 2)])
def test_a_kill_leaves_what_can_be_finished_or_put_back(tmp_path, monkeypatch, begin, options, step):
    checkout = make(tmp_path / "checkout", {"train.py": TRAIN + "\n\nif __name__ == '__main__':\n    training(*x)\n"})
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
        assert contents(path) != before
        patches.revert(path)
        assert contents(path) == before


@pytest.mark.parametrize("step", [1, 4, 5])
def test_a_full_disk_or_a_folder_that_may_not_be_written_changes_nothing(tmp_path, monkeypatch, step):
    make(tmp_path)
    failing_at(step, OSError(28, "No space left on device"), monkeypatch)
    refused(tmp_path, "cannot be written: [Errno 28]", f"`dsmoe patch check {tmp_path}` says how the checkout is")


SCRIPT = "import torch\nif __name__ == '__main__':\n    torch.load('x')\n"


def test_options_are_added_to_a_patch_and_stay_with_it(tmp_path, dsmoe):
    setup = "submodules/grid/setup.py"
    make(tmp_path, {"metrics.py": SCRIPT, "utils/x.py": SCRIPT, setup: "flags = ['-O2', '-std=c++14']\n"})
    before = contents(tmp_path)
    patches.apply(tmp_path)
    assert (tmp_path / "metrics.py").read_text() == SCRIPT
    for words, options in ((["--fuse"], ["fuse"]), (["--modernise"], ["fuse", "modernise"])):
        assert patches.check(tmp_path).state == "patched"
        said = dsmoe("patch", "apply", *words, tmp_path)
        assert said.status == 0 and f"metrics.py: {', '.join(options)}" in said.out
        assert patches.check(tmp_path).applied == options and not patches.apply(tmp_path).written
    first, second, *rest = (tmp_path / "metrics.py").read_text().splitlines(keepends=True)
    assert first == marked("from dsmoe.patches import modernise; modernise.start()")
    assert second == marked("from dsmoe.patches import fuse; fuse.start()")
    assert "".join(rest) == SCRIPT
    assert (tmp_path / setup).read_text() == "flags = ['-O2', '-DDSMOE_PATCH_STD=14']\n"
    assert (tmp_path / "utils/x.py").read_text() == SCRIPT
    assert "patched (3dgs-2023, --fuse, --modernise)" in dsmoe("patch", "check", tmp_path).out
    patches.revert(tmp_path)
    assert contents(tmp_path) == before


def test_edits_stay_when_the_patch_goes(tmp_path, dsmoe):
    patches.apply(make(tmp_path))
    edited = (tmp_path / "train.py").read_text().replace("first_iter = 0", "first_iter = 5") + "\n# mine\n"
    (tmp_path / "train.py").write_text(edited)
    assert patches.check(tmp_path).state == "patched" and not patches.apply(tmp_path).written
    said = dsmoe("patch", "revert", tmp_path)
    assert said.status == 0 and "as it was before the patch (4 files)" in said.out
    assert (tmp_path / "train.py").read_text() == TRAIN.replace("first_iter = 0", "first_iter = 5") + "\n# mine\n"
    assert (tmp_path / GR).read_text() == RENDERER


INRIA = "diff_smoe_rasterization.integrations.inria"
OF_DATASET = digest("pipe.blend = blend_of(dataset)")


@pytest.mark.parametrize("name, old, new, words", [
    ("train.py", "    pipe.blend", "    if 1:\n        pipe.blend", "train.py: without the lines of the patch it is"),
    (GR, "\nfrom diff_smoe", "\n\nfrom diff_smoe", "it still has `# dsmoe patch 3dgs-2023: diff"),
    (GR, f"# dsmoe patch 3dgs-2023: diff_gaussian_rasterization {digest(INRIA)}\n", "",
     "still has `from diff_smoe_rasterization."),
    (GR, f"from {INRIA}", "from mine.rasterizer", "it still has `# dsmoe patch 3dgs-2023: diff"),
    (GR, f"from {INRIA}", f"from {INRIA}_2024", "it still has `# dsmoe patch 3dgs-2023: diff"),
    # Code and words of the user's on a line of the patch.
    (GR, "(pipe),  #", "(pipe), sh_degree=3,  #", "still has `**chosen_blend(pipe), sh_degree=3,  # dsmoe patch"),
    (GR, "(pipe),  #", "(mine),  #", "still has `**chosen_blend(mine),  # dsmoe patch"),
    ("train.py", "blend_of(dataset)", "blend_of(dataset); lr = 5", "still has `pipe.blend = blend_of(dataset); lr = 5"),
    ("train.py", "blend_of(dataset)", "blend_of(args)", "still has `pipe.blend = blend_of(args)"),
    ("train.py", "    pipe.blend", "    # pipe.blend", "still has `# pipe.blend = blend_of(dataset)"),
    ("train.py", "pipe.blend =", "pipe.mode = pipe.blend =", "still has `pipe.mode = pipe.blend = blend_of(dataset)"),
    ("train.py", "blend_of(dataset)", "{'blend_mode': 'smoe'}", "still has `pipe.blend = {'blend_mode': 'smoe'}"),
    ("train.py", f"  # dsmoe patch {OF_DATASET}", "", "without the lines of the patch it still has `pipe.blend ="),
    ("train.py", "import blend_of", "import blend_of; import wandb", "import wandb  # dsmoe patch"),
    ("train.py", f"{OF_DATASET}\n", f"{OF_DATASET}, mine\n", f"  # dsmoe patch {OF_DATASET}, mine`")])
def test_an_edit_without_which_no_file_comes_back_is_named(tmp_path, name, old, new, words):
    patches.apply(make(tmp_path))
    assert (tmp_path / name).read_text().count(old) == 1
    (tmp_path / name).write_text((tmp_path / name).read_text().replace(old, new))
    refused(tmp_path, "nothing was touched", words, call=patches.revert)
    if "without" not in words:
        said = "imports mine, another rasterizer" if "mine.rasterizer" in new else "drifted"
        refused(tmp_path, said)
        refused(tmp_path, said, fuse=True)


def test_an_edit_of_a_flag_of_the_patchs_is_named(tmp_path):
    make(tmp_path, {"submodules/grid/setup.py": "flags = ['-std=c++14']\n"})
    patches.apply(tmp_path, modernise=True)
    (tmp_path / "submodules/grid/setup.py").write_text("flags = ['-DDSMOE_PATCH_STD=17']\n")
    refused(tmp_path, "setup.py: without the lines of the patch it still has `flags = ['-DDSMOE_PATCH_STD=17']`",
            call=patches.revert)


@pytest.mark.parametrize("call", [patches.apply, patches.revert])
@pytest.mark.parametrize("step", [1, 5])
def test_what_an_editor_saves_meanwhile_stays(tmp_path, monkeypatch, call, step):
    """Before the first file is replaced, and behind it: four files are written, then each takes its place."""
    make(tmp_path)
    if call is patches.revert:
        patches.apply(tmp_path)
    before, done, write, replace = contents(tmp_path), [], Path.write_bytes, os.replace

    def save_at_step(act, *arguments):
        done.append(arguments)
        act(*arguments)
        if len(done) == step:
            write(tmp_path / "train.py", b"# mine\n")

    with monkeypatch.context() as patch, pytest.raises(patches.PatchError, match="train.py: another program has saved"):
        patch.setattr(Path, "write_bytes", lambda *arguments: save_at_step(write, *arguments))
        patch.setattr(os, "replace", lambda *arguments: save_at_step(replace, *arguments))
        call(tmp_path)
    assert (tmp_path / "train.py").read_text() == "# mine\n"
    written = [name for name, content in contents(tmp_path).items() if content != before[name]]
    assert len(written) == (1 if step == 1 else 4) and "train.py" in written


def test_an_argument_does_not_become_a_part_of_a_comment(tmp_path):
    patches.apply(make(tmp_path))
    text = (tmp_path / GR).read_text().replace("**chosen", "# **chosen")
    (tmp_path / GR).write_text(text)
    refused(tmp_path, "still has `# **chosen_blend(pipe),", call=patches.revert)


@pytest.mark.parametrize("line", ["x = 1  # dsmoe patch\n", "# dsmoe patch, by me\n",
                                  '"""\nx  # dsmoe patch\n"""\n'])
def test_the_mark_in_text_of_the_users_is_named_before_anything_is_written(tmp_path, line):
    make(tmp_path, {"train.py": TRAIN + line})
    refused(tmp_path, "unpatchable", "train.py: still has `", "# dsmoe patch", "change that line")
    refused(tmp_path, "train.py: ", call=patches.revert)


@pytest.mark.parametrize("sign", [".git", "pyproject.toml"])
def test_another_repository_in_the_checkout_is_let_be(tmp_path, sign):
    """For example a clone of this package: its files name the mark."""
    make(tmp_path, {f"dsmoe/{sign}": "", "dsmoe/own.py": RENDERER, "dsmoe/patches/source.py": "x = 1  # dsmoe patch\n"})
    before = contents(tmp_path)
    assert "dsmoe/own.py" not in patches.apply(tmp_path).rules
    patches.revert(tmp_path)
    assert contents(tmp_path) == before


def test_a_script_that_cannot_begin_with_an_option_is_named(tmp_path):
    texts = {"only.py": '"""Run as __main__."""\n', "two.py": '"""__main__"""; import os\n', "no.py": "__main__ =\n"}
    notes = patches.apply(make(tmp_path, texts), modernise=True).notes
    assert [note.partition(": ")[0] for note in notes] == sorted(texts)
    assert all("does not begin with modernise.start()" in note for note in notes)
    make(tmp_path / "none")
    assert "--fuse: fits no script: no .py beside train.py" in patches.apply(tmp_path / "none", fuse=True).notes[0]


def test_two_at_once_do_not_share_new_files(tmp_path, monkeypatch):
    """The second is killed in the middle of a new file, before the first puts its own in place.

    Both let be what a third that runs has begun. What one left that runs no more goes.
    """
    replace = os.replace
    make(tmp_path)
    with subprocess.Popen(["true"]) as ended:
        pass
    of_a_third, left = (tmp_path / f"{engine.UNFINISHED}abcdefgh.{number}" for number in (os.getppid(), ended.pid))
    of_a_third.mkdir()
    left.mkdir()

    def first(*arguments):
        monkeypatch.setattr(os, "replace", replace)
        with monkeypatch.context() as patch, pytest.raises(Killed):
            failing_at(1, Killed(), patch)
            patches.apply(tmp_path)
        return replace(*arguments)

    monkeypatch.setattr(os, "replace", first)
    patches.apply(tmp_path)
    assert {name: (tmp_path / name).read_text() for name in PATCHED} == PATCHED
    assert list(tmp_path.glob(".*")) == [of_a_third]


def test_a_folder_that_may_not_be_written_is_named_before_anything_is(tmp_path, monkeypatch):
    access = os.access
    make(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(os, "access", lambda path, mode: access(path, mode) and (
            mode != os.W_OK or Path(path).name != "gaussian_renderer"))
        refused(tmp_path, "gaussian_renderer: you may not write in this folder")


def test_files_of_another_commit_are_patched_anew(tmp_path):
    """Single ones that `git checkout` brought, and all."""
    patches.apply(make(tmp_path))
    (tmp_path / "train.py").write_text("# a later version\n" + TRAIN)
    planned = patches.check(tmp_path)
    assert planned.state == "half-patched" and planned.reasons[0].startswith("train.py: is not as this version")
    assert patches.apply(tmp_path).written and patches.check(tmp_path).state == "patched"
    make(tmp_path, {"train.py": "# a later version\n" + TRAIN})
    assert patches.check(tmp_path).state == "patchable" and patches.apply(tmp_path).written
    (tmp_path / "train.py").unlink()
    refused(tmp_path, "drifted", "train.py: rule pipe-blend-mode: there is no such file")
    patches.revert(tmp_path)
    assert (tmp_path / "render.py").read_text() == RENDER and not (tmp_path / "train.py").exists()


def test_lines_of_another_version_are_replaced(tmp_path):
    patches.apply(make(tmp_path))
    former = PATCHED["train.py"].replace(*map(marked, ("pipe.blend = blend_of(dataset)", "pipe.mode = blend_of(pipe)")))
    (tmp_path / "train.py").write_text(former)
    assert patches.check(tmp_path).state == "half-patched" and patches.apply(tmp_path).written
    assert (tmp_path / "train.py").read_text() == PATCHED["train.py"]


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


@pytest.mark.parametrize("name, mode", [("output", 0), ("a/b", 0o400), ("gaussian_renderer", 0o100), (".", 0)])
def test_a_folder_that_may_not_be_read_is_named(tmp_path, name, mode):
    locked = make(tmp_path / "checkout") / name
    locked.mkdir(parents=True, exist_ok=True)
    locked.chmod(mode)
    done = unprivileged.dsmoe("patch", "check", tmp_path / "checkout")
    locked.chmod(0o700)
    assert (done.returncode, done.stdout) == (1, "") and done.stderr.count("\n") == 1
    assert f"{locked}: you may not read this folder" in done.stderr and "chmod u+rx" in done.stderr


SCRIPTS = {  # of the user's own: text, what is said of it
    "tools/deep/own.py": ("from diff_gaussian_rasterization._C import mark_visible\n", "is the original rasterizer"),
    "whole.py": ("import diff_gaussian_rasterization as dgr\n", "is the original rasterizer"),
    "a.py": ("try:\n    import diff_gaussian_rasterization as r\nexcept: 0\n", "is the original rasterizer"),
    "settings.py": ("from diff_gaussian_rasterization import GaussianRasterizationSettings\n"
                    "def show(pipe):\n    return GaussianRasterizationSettings(debug=False)\n", "without a blend mode"),
    "broken.py": ("import diff_gaussian_rasterization\n\0x", "is the original rasterizer"),
    "utils/loss.py": ("try:\n    from diff_gaussian_rasterization._C import fusedssim\nexcept ImportError: 0\n", None),
    "tools/own.py": ("from diff_gaussian_rasterization import GaussianRasterizer\n", None),  # a rule changes it
    "viewer.py": ("from diff_gaussian_rasterization import GaussianRasterizationSettings\n"
                  "def show(pipe):\n    return GaussianRasterizationSettings(debug=pipe.debug)\n", None),
    "why.py": ("# as diff_gaussian_rasterization does\n", None), "out/cfg_args": ("", None),
    "out/backup/film.py": ("import diff_gaussian_rasterization\n", None), "env/pyvenv.cfg": ("", None),
    "env/film.py": ("import diff_gaussian_rasterization\n", None),
    ".cache/film.py": ("import diff_gaussian_rasterization\n", None)}


def test_scripts_get_the_rasterizer_and_those_that_no_rule_reaches_are_named(tmp_path):
    make(tmp_path, {name: text for name, (text, _) in SCRIPTS.items()})
    for _ in range(2):  # before the patch, and when it is there
        notes = {note.partition(": ")[0]: note for note in patches.check(tmp_path).notes}
        assert set(notes) == {name for name, (_, word) in SCRIPTS.items() if word}
        assert all(SCRIPTS[name][1] in note for name, note in notes.items())
        patches.apply(tmp_path)
    for name in ("tools/own.py", "viewer.py"):
        assert "diff_smoe_rasterization.integrations.inria " in (tmp_path / name).read_text()
    assert "**chosen_blend(pipe)" in (tmp_path / "viewer.py").read_text()


def test_what_the_command_says(tmp_path, dsmoe):
    make(tmp_path)
    said = dsmoe("patch", "diff", tmp_path)
    assert said.status == 0 and said.out == patches.diff(tmp_path)
    assert dsmoe("patch", "check", tmp_path).out == f"{tmp_path}: patchable (3dgs-2023)\n"
    said = dsmoe("patch", "apply", tmp_path)
    assert said.status == 0 and "train.py: pipe-blend-mode" in said.out
    assert "already patched" in dsmoe("patch", "apply", tmp_path).out
    for words in (["patch", "apply"], ["patch", "revert"]):
        said = dsmoe(*words, tmp_path, "--modernize")
        assert said.status == 2 and f"usage: dsmoe {' '.join(words)} " in said.err and "--modernize" in said.err


def test_the_readme_has_every_trainer_rule_and_state():
    from dsmoe.patches.rules import OPTIONS, rules_of
    from dsmoe.patches.trainers import TRAINERS

    text = (Path(__file__).resolve().parents[3] / "dsmoe" / "patches" / "README.md").read_text()
    cells = {line.split(" | ")[0].strip(" |`"): line for line in text.splitlines() if line.startswith("| `")}
    for trainer in TRAINERS:
        assert not trainer.entries or f"`{trainer.name}`" in cells[trainer.flavour].partition(" | ")[2]
        assert {rule.name for rule in rules_of(trainer, {}, False)} <= set(cells)
        assert all(f"`{rule.function}`" in text for rule in trainer.entries)
    assert all(f"## --{option}\n" in text for option in OPTIONS)
    assert "says patchable, patched, half-patched, drifted, unpatchable, supported or unknown" in text


def test_a_folder_of_the_users_stays(tmp_path):
    """Only a folder that ends with a process's number is of a patch that was interrupted."""
    checkout = make(tmp_path, {".dsmoe_unfinished_my_notes/a.txt": "mine", ".dsmoe_unfinished/b.txt": "mine",
                               ".dsmoe_unfinishedabcd1234.4194305/train.py": "left by a process that ended"})
    patches.apply(checkout)
    left = {path.name for path in checkout.glob(".dsmoe_unfinished*")}
    assert left == {".dsmoe_unfinished_my_notes", ".dsmoe_unfinished"}
    patches.revert(checkout)
    assert (checkout / ".dsmoe_unfinished_my_notes/a.txt").read_text() == "mine"


def test_a_long_line_is_read_in_time(tmp_path):
    """100,000 minuses took minutes: the search for a mark began anew at each."""
    begin = time.monotonic()
    refused(make(tmp_path, {"arguments/__init__.py": "-" * 100_000}), "is not Python that can be parsed")
    assert time.monotonic() - begin < 10


def test_where_no_patch_fits_dsmoe_run_is_named(tmp_path):
    """A July of 2023 without `debug`, and a checkout without gaussian_renderer."""
    early = patches.check(make(tmp_path / "early", {GR: RENDERER.replace("debug=pipe.debug  # slow", "")}))
    assert early.state == "unpatchable" and "dsmoe run --blend-mode smoe -- python train.py" in early.reasons[-1]
    flat = patches.check(make(tmp_path / "flat", {GR: None, "train.py": RENDERER + "def training(): pass\n"}))
    assert flat.state == "supported" and any("dsmoe run --blend-mode smoe -- python" in line for line in flat.reasons)


def test_what_dsmoe_run_takes_is_supported(tmp_path, dsmoe):
    """And only that: the same rasterizer beside another one that is always imported is not."""
    mip = RENDERER.replace("bg=bg_color", "bg=bg_color, kernel_size=0.1")
    said = dsmoe("patch", "check", make(tmp_path / "mip", {GR: mip}))
    assert said.status == 0 and "mip: supported\n" in said.out and "type `dsmoe run" in said.out
    refused(tmp_path / "mip", "the checkout is supported, but not by a patch:", "for which there is no patch: type")
    two = make(tmp_path / "two", {GR: mip + "from diff_surfel_rasterization import GaussianRasterizer as Other\n"})
    said = dsmoe("patch", "check", two)
    assert said.status == 1 and ": unknown\n" in said.out


def test_the_script_that_trains_is_named(tmp_path, dsmoe):
    """Whatever its name is; in a folder below the package that calls another rasterizer, as in gsplat's checkout."""
    script = "from gsplat import rasterization\nif __name__ == '__main__':\n    rasterization(1, 2, 3, 4, 5)\n"
    (tmp_path / "examples").mkdir()
    (tmp_path / "examples/simple_trainer.py").write_text(script)
    inside = dsmoe("patch", "check", tmp_path / "examples")
    assert inside.status == 0 and "`dsmoe run --blend-mode smoe -- python simple_trainer.py ...` in it" in inside.out
    (tmp_path / "examples/simple_trainer.py").rename(tmp_path / "examples/distill_train.py")
    (tmp_path / "examples/train_prune.py").write_text(script)
    assert "python train_prune.py ..." in dsmoe("patch", "check", tmp_path / "examples").out
    (tmp_path / "tests").mkdir()
    for name in ("tests/train.py", "test_train.py"):
        (tmp_path / name).write_text(script)
    (tmp_path / "own.py").write_text("from diff_surfel_rasterization import GaussianRasterizer\n")
    above = dsmoe("patch", "check", tmp_path)
    assert above.status == 1 and "name the folder of the script that you run, such as examples\n" in above.out


def test_imports_that_are_missing_are_named_once_patched(tmp_path):
    """Of the scripts and what they import; not what is tried, is of the checkout, or comes with the patch."""
    train = "import cv2_no, utils.own, torch, fused_ssim, _gridencoder\n" + (
        "try:\n    import wandb_no\nexcept ImportError: pass\n" + TRAIN)
    files = {"train.py": train, "utils/own.py": "from yaml_no import load\nimport helper\n", "utils/helper.py": "",
             "alone.py": "import alone_no\n"}
    assert patches.apply(make(tmp_path, files)).notes[-3:] == [
        "not installed here: cv2_no, yaml_no; pip install cv2_no yaml_no",
        "not installed here: _gridencoder; compile what the trainer's page names",
        "not installed here: fused_ssim; --modernise brings this package's"]
    assert patches.apply(tmp_path, modernise=True).notes[-2].startswith("not installed here: cv2_no, yaml_no; ")
    assert not patches.apply(make(tmp_path / "plain")).notes
