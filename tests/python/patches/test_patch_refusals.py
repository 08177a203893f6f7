"""What `dsmoe patch` refuses: it names file and rule, and leaves every byte as it was."""
from __future__ import annotations

import os
import re
import shutil
import signal
import sys
import tempfile
from pathlib import Path

import pytest
from checkouts import ENTRIES, RECORD, TRAINERS, changed_files, contents, make_checkout

from diff_smoe_rasterization import patches

pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")

NOBODY = 65534


def replace_once(path, old, new):
    text = path.read_text()
    assert text.count(old) >= 1, f"{path} has no {old!r}"
    path.write_text(text.replace(old, new, 1))


def refused(result, *names):
    """Status 1, and a message on stderr that has all of `names`."""
    assert result.status == 1, (result.out, result.err)
    for name in names:
        assert name in result.err, result.err
    return True


# What each file that a patch changes could have become: file, what is there, what came instead.
NONE = {
    "no settings": ("gaussian_renderer/__init__.py", "GaussianRasterizationSettings(\n", "make_settings(\n"),
    "no ModelParams": ("arguments/__init__.py", "class ModelParams(", "class ModelFlags("),
    "no super().__init__": ("arguments/__init__.py", 'super().__init__(parser, "What is loaded", sentinel)', "pass"),
    "no entry": ("{last}", "def {entry}(", "def {entry}_of_ours("),
}
SEVERAL = {
    "two ModelParams": ("arguments/__init__.py", "class ModelParams(ParamGroup):", "class ModelParams(ParamGroup):\n"
                        "    def __init__(self, parser):\n        super().__init__(parser)\n\n\n"
                        "class ModelParams(ParamGroup):"),
    "two entries": ("{last}", "def {entry}(", "def {entry}(dataset, pipe, pipeline, model_params, pipeline_params):\n"
                    "    pass\n\n\ndef {entry}("),
}


DRIFTS = {**NONE, **SEVERAL}
DRIFTED = ([("3dgs-2023", drift) for drift in DRIFTS] + [("c3dgs", "no entry"), ("c3dgs", "two entries")]
           + [("hac", "no settings"), ("hac", "no entry")])


@pytest.mark.parametrize("name, drift", DRIFTED)
def test_none_or_several_matches_are_refused(name, drift, tmp_path, dsmoe):
    last = list(ENTRIES[name])[-1]
    file, old, new = (words.format(last=last, entry=ENTRIES[name][last][-1]) for words in DRIFTS[drift])
    checkout = make_checkout(name, tmp_path / "checkout")
    replace_once(checkout / file, old, new)
    before = contents(checkout)
    assert refused(dsmoe("patch", "check", checkout), "drifted", file)
    result = dsmoe("patch", "apply", checkout)
    assert refused(result, file) and re.search(r"rule [a-z-]+", result.err), result.err
    assert contents(checkout) == before


def test_a_refusal_is_the_same_by_every_way(tmp_path, dsmoe):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    file, old, new = NONE["no ModelParams"]
    replace_once(checkout / file, old, new)
    before = contents(checkout)
    for words in (["apply", "--dry-run"], ["apply", "--modernise"], ["diff"]):
        assert refused(dsmoe("patch", words[0], checkout, *words[1:]), file)
    for function in (patches.apply, patches.diff):
        with pytest.raises(patches.PatchError, match=re.escape(file)):
            function(checkout)
    assert contents(checkout) == before


def test_no_settings_are_left_without_the_mode(tmp_path, dsmoe):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    renderer = checkout / "gaussian_renderer" / "__init__.py"
    replace_once(renderer, "    shape =", "    other = GaussianRasterizationSettings(debug=False)\n    shape =")
    before = contents(checkout)
    result = dsmoe("patch", "apply", checkout)
    if result.status != 0:
        assert refused(result, "gaussian_renderer/__init__.py") and contents(checkout) == before
    else:
        text = renderer.read_text()
        assert text.count("**pipe.blend,") == text.count("GaussianRasterizationSettings(") == 2


@pytest.mark.parametrize("name", ["3dgs-2024", "c3dgs", "hac-plus"])
def test_a_file_that_is_no_python_is_refused(name, tmp_path, dsmoe):
    checkout = make_checkout(name, tmp_path / "checkout")
    last = list(ENTRIES[name])[-1]
    with open(checkout / last, "a") as file:
        file.write("\ndef broken(:\n")
    before = contents(checkout)
    assert refused(dsmoe("patch", "apply", checkout), last)
    assert contents(checkout) == before


def test_a_missing_file_is_refused(tmp_path, dsmoe):
    checkout = make_checkout("3dgs-2024", tmp_path / "checkout")
    (checkout / "render.py").unlink()
    before = contents(checkout)
    assert refused(dsmoe("patch", "apply", checkout), "render.py")
    assert contents(checkout) == before


def test_what_is_no_checkout_is_unknown(tmp_path, dsmoe):
    (tmp_path / "empty").mkdir()
    make_checkout("3dgs-2023", tmp_path / "other rasterizer")
    renderer = tmp_path / "other rasterizer" / "gaussian_renderer" / "__init__.py"
    replace_once(renderer, "diff_gaussian_rasterization", "some_other_rasterizer")
    replace_once(renderer, "GaussianRasterizationSettings, ", "")
    before = contents(tmp_path)
    for folder in ("empty", "other rasterizer"):
        for action in ("check", "apply", "diff"):
            assert refused(dsmoe("patch", action, tmp_path / folder), "unknown")
        with pytest.raises(patches.PatchError):
            patches.apply(tmp_path / folder)
    for action in ("check", "apply", "diff", "revert"):
        assert refused(dsmoe("patch", action, tmp_path / "missing"), "missing")
    assert contents(tmp_path) == before


def test_a_trainer_that_it_is_not_is_refused(tmp_path, dsmoe):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    before = contents(checkout)
    assert refused(dsmoe("patch", "apply", checkout, "--trainer", "taming"), "taming")
    result = dsmoe("patch", "apply", checkout, "--trainer", "3dgs-2022")
    assert result.status != 0 and all(name in result.err for name in TRAINERS)
    with pytest.raises(patches.PatchError):
        patches.apply(checkout, trainer="hac")
    assert contents(checkout) == before


@pytest.fixture
def writable_for_nobody():
    """A folder that the user `nobody` owns, who root may become: nothing is read-only for root."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


@pytest.mark.parametrize("locked", ["gaussian_renderer", "gaussian_renderer/__init__.py", ".", "render.py"])
def test_what_cannot_be_written_is_refused(locked, writable_for_nobody, dsmoe):
    checkout = make_checkout("3dgs-2023", writable_for_nobody / "checkout")
    before = contents(checkout)
    (checkout / locked).chmod(0o555)
    if os.geteuid() == 0:
        for path in (checkout, *checkout.rglob("*")):
            os.chown(path, NOBODY, NOBODY)

    def apply():
        if os.geteuid() == 0:
            os.setuid(NOBODY)
        result = dsmoe("patch", "apply", checkout)
        named = Path(locked).name if locked != "." else "checkout"
        assert refused(result, named)

    assert in_a_fork(apply) == 0
    (checkout / locked).chmod(0o755 if (checkout / locked).is_dir() else 0o644)
    assert contents(checkout) == before


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

        def counted(*arguments, **keywords):
            if count[0] == step:
                os.kill(os.getpid(), signal.SIGKILL)
            count[0] += 1
            return replace(*arguments, **keywords)

        os.replace = os.rename = counted
        action()

    status = in_a_fork(run)
    assert status in (0, -signal.SIGKILL)
    return status != 0


def test_an_interrupted_apply_is_reverted_or_finished(tmp_path, dsmoe):
    before = contents(make_checkout("3dgs-2023", tmp_path / "fresh"))
    patches.apply(shutil.copytree(tmp_path / "fresh", tmp_path / "whole"))
    whole, states = contents(tmp_path / "whole", record=False), set()
    for step in range(100):
        torn = shutil.copytree(tmp_path / "fresh", tmp_path / f"torn {step}")
        if not killed_at(step, lambda: patches.apply(torn)):
            break
        changed = changed_files(before, contents(torn, record=False))
        states.add(len(changed))
        assert all(contents(torn)[file] == whole[file] for file in changed), "a file is neither old nor new"
        said = dsmoe("patch", "check", torn)
        if changed:
            assert refused(said, "half-patched") if len(changed) < 4 else said.status == 0

        finished = shutil.copytree(torn, tmp_path / f"finished {step}")
        assert dsmoe("patch", "apply", finished).status == 0
        assert contents(finished, record=False) == whole
        assert dsmoe("patch", "revert", finished).status == 0
        assert contents(finished) == before

        if (torn / RECORD).exists():
            assert dsmoe("patch", "revert", torn).status == 0
        assert contents(torn) == before
    assert {0, 1, 2, 3} <= states


def test_an_interrupted_revert_is_finished(tmp_path, dsmoe):
    before = contents(make_checkout("3dgs-2023", tmp_path / "fresh"))
    patches.apply(shutil.copytree(tmp_path / "fresh", tmp_path / "whole"))
    interrupted = 0
    for step in range(100):
        torn = shutil.copytree(tmp_path / "whole", tmp_path / f"torn {step}")
        if not killed_at(step, lambda: patches.revert(torn)):
            break
        interrupted += 1
        assert dsmoe("patch", "revert", torn).status == 0
        assert contents(torn) == before
    assert interrupted >= 3


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_an_error_while_writing_leaves_nothing_half_done(error, tmp_path, monkeypatch, dsmoe):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    before, replace, count = contents(checkout), os.replace, [0]

    def failing(source, target, **keywords):
        if Path(target).name == "train.py" and RECORD not in str(target):
            count[0] += 1
            if count[0] == 1:
                raise error
        return replace(source, target, **keywords)

    monkeypatch.setattr(os, "replace", failing)
    status = None
    try:
        status = dsmoe("patch", "apply", checkout).status
    except KeyboardInterrupt:
        pass
    monkeypatch.undo()
    assert count[0] >= 1 and status != 0
    if contents(checkout) != before:
        assert dsmoe("patch", "revert", checkout).status == 0
    assert contents(checkout) == before


@pytest.mark.parametrize("file", ["train.py", "gaussian_renderer/__init__.py"])
def test_a_file_restored_by_hand_is_reported(file, tmp_path, dsmoe):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    original = (checkout / file).read_bytes()
    assert dsmoe("patch", "apply", checkout).status == 0
    (checkout / file).write_bytes(original)
    before = contents(checkout)
    assert refused(dsmoe("patch", "check", checkout), "half-patched", file)
    assert refused(dsmoe("patch", "apply", checkout), file)
    assert contents(checkout) == before


@pytest.mark.parametrize("file", ["train.py", "render.py", "arguments/__init__.py", "gaussian_renderer/__init__.py"])
def test_a_file_patched_by_hand_is_reported(file, tmp_path, dsmoe):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    patches.apply(make_checkout("3dgs-2023", tmp_path / "patched"))
    shutil.copy(tmp_path / "patched" / file, checkout / file)
    before = contents(checkout)
    assert refused(dsmoe("patch", "check", checkout), "half-patched", file)
    assert refused(dsmoe("patch", "apply", checkout), file)
    assert refused(dsmoe("patch", "revert", checkout))
    assert contents(checkout) == before


def test_a_patch_without_its_record_is_known_and_not_taken_back(tmp_path, dsmoe):
    checkout = make_checkout("hac", tmp_path / "checkout")
    patches.apply(checkout)
    shutil.rmtree(checkout / RECORD)
    before = contents(checkout)
    assert ": patched" in dsmoe("patch", "check", checkout).out
    assert dsmoe("patch", "apply", checkout).status == 0
    assert refused(dsmoe("patch", "revert", checkout))
    assert contents(checkout) == before


@pytest.mark.parametrize("name", ["3dgs-2024", "hac"])
def test_revert_keeps_what_was_edited_since(name, tmp_path, dsmoe):
    checkout = make_checkout(name, tmp_path / "checkout")
    before = contents(checkout)
    patches.apply(checkout)
    changed = sorted(changed_files(before, contents(checkout, record=False)))
    assert len(changed) >= 3
    for file in changed:
        text = (checkout / file).read_text()
        (checkout / file).write_text(text + "# a line of the user\n")
    (checkout / "notes.txt").write_text("no file of the patch")
    said = dsmoe("patch", "revert", checkout)
    edited = said.out.strip().partition("with your edits of ")[2].split(", ")
    assert said.status == 0 and sorted(edited) == changed
    (checkout / "notes.txt").unlink()
    for file in changed:
        text = (checkout / file).read_text()
        (checkout / file).write_text(text[:text.rindex("# a line of the user\n")])
    assert contents(checkout) == before


def test_revert_of_what_is_not_patched_is_refused(tmp_path, dsmoe):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    before = contents(checkout)
    assert refused(dsmoe("patch", "revert", checkout), "checkout")
    assert contents(checkout) == before
