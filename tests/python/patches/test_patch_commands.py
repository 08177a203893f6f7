"""`dsmoe patch apply`, `check`, `diff` and `revert` on whole checkouts: what is changed, and that nothing else is."""
from __future__ import annotations

import ast
import difflib
import shutil
import subprocess
import sys
from collections import Counter
from types import SimpleNamespace

import pytest
from checkouts import ENTRIES, RECORD, TRAINERS, changed_files, contents, definitions, environment, make_checkout

from diff_smoe_rasterization import patches

pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")


@pytest.fixture(scope="module", params=TRAINERS)
def story(request, tmp_path_factory, dsmoe):
    """What the commands say and leave behind, one after the other, on a checkout of each trainer."""
    name, folder = request.param, tmp_path_factory.mktemp("story") / "some folder"
    made = SimpleNamespace(name=name, original=make_checkout(name, folder.parent / "original"), states={}, said={})
    make_checkout(name, folder)

    def step(title, *words):
        made.said[title] = dsmoe("patch", *words, folder)
        made.states[title] = contents(folder)

    made.states["start"] = contents(folder)
    step("checked", "check")
    step("shown", "diff")
    step("tried", "apply", "--dry-run")
    step("applied", "apply")
    made.patched = shutil.copytree(folder, folder.parent / "patched")
    step("applied, checked", "check")
    step("applied twice", "apply")
    step("reverted", "revert")
    return made


def test_each_trainer_has_a_small_one():
    """But Scaffold-GS, of which HAC is made; see test_engine_versions.py."""
    assert sorted(patches.TRAINERS) == sorted([*TRAINERS, "scaffold-gs"])


def test_a_checkout_is_recognised_whatever_its_folder_is_called(story):
    said = story.said["checked"]
    assert said.status == 0 and "patchable" in said.out and f"({story.name})" in said.out


@pytest.mark.parametrize("step", ["checked", "shown", "tried", "reverted"])
def test_what_only_looks_or_takes_back_leaves_every_byte(story, step):
    assert story.said[step].status == 0
    assert story.states[step] == story.states["start"]


def test_applying_twice_is_applying_once(story):
    assert story.said["applied"].status == story.said["applied twice"].status == 0
    assert story.states["applied"] != story.states["start"]
    assert story.states["applied twice"] == story.states["applied"]
    assert "already" in story.said["applied twice"].out


def test_a_patched_checkout_is_recognised(story):
    said = story.said["applied, checked"]
    assert said.status == 0 and ": patched" in said.out and story.name in said.out
    assert (story.patched / RECORD).is_dir()


def changed_lines(diff):
    """{file: Counter of its lines with - or + in front} of a unified diff."""
    found = {}
    for line in diff.splitlines():
        if line.startswith("+++ b/"):
            lines = found[line[6:]] = Counter()
        elif line[:1] in "+-" and not line.startswith("--- a/"):
            lines[line] += 1
    return found


def lines_between(before, after):
    """The same of two states of a folder."""
    found = {}
    for file in changed_files(before, after):
        old, new = (state[file][1].decode().splitlines() for state in (before, after))
        found[file] = Counter(line[0] + line[2:] for line in difflib.ndiff(old, new) if line[0] in "+-")
    return found


def test_the_diff_is_what_apply_does(story):
    shown = changed_lines(story.said["shown"].out)
    assert shown == changed_lines(story.said["tried"].out)
    assert shown == lines_between(story.states["start"], contents(story.patched, record=False))


def test_only_imports_settings_model_params_and_entries_change(story):
    expected = {("arguments/__init__.py", "ModelParams.__init__"), ("gaussian_renderer/__init__.py", "render")}
    if story.name.startswith("hac"):
        expected.add(("gaussian_renderer/__init__.py", "prefilter_voxel"))
    for file, functions in ENTRIES[story.name].items():
        expected.update((file, function) for function in functions)

    changed = set()
    for file in changed_files(contents(story.original), contents(story.patched, record=False)):
        old, new = definitions(story.original / file), definitions(story.patched / file)
        assert set(old) == set(new)
        for function in old:
            if ast.dump(old[function]) != ast.dump(new[function]):
                changed.add((file, function))
                take_out_what_a_patch_adds(new[function], function)
                assert ast.dump(old[function]) == ast.dump(new[function]), f"{file}: {function}"
    assert changed == expected


def take_out_what_a_patch_adds(function, name):
    """The settings' keywords from a renderer; the one statement about `blend` from others."""
    if name in ("render", "prefilter_voxel"):
        for node in ast.walk(function):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "GaussianRasterizationSettings":
                node.keywords = [keyword for keyword in node.keywords if keyword.arg]
        return
    mentions = [statement for statement in function.body if "'blend" in ast.dump(statement)]
    assert len(mentions) == 1, f"{name}: {len(mentions)} statements about the mode"
    function.body.remove(mentions[0])


def imported_names(path):
    nodes = [node for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, (ast.Import, ast.ImportFrom))]
    return Counter((getattr(node, "module", None), alias.name, alias.asname) for node in nodes for alias in node.names)


def test_imports_change_their_module_alone(story):
    for file in changed_files(contents(story.original), contents(story.patched, record=False)):
        old, new = imported_names(story.original / file), imported_names(story.patched / file)
        gone, come = old - new, new - old
        assert {module for module, _, _ in gone} <= {"diff_gaussian_rasterization"}
        assert all(module.startswith("diff_smoe_rasterization") for module, _, _ in come)
        assert {(what, name) for _, what, name in gone} <= {(what, name) for _, what, name in come}


@pytest.mark.parametrize("name", TRAINERS)
def test_modernising_is_asked_for_and_taken_back(name, tmp_path, dsmoe):
    checkout = make_checkout(name, tmp_path / "checkout")
    before = contents(checkout)
    plain, modern = (changed_lines(dsmoe("patch", "diff", checkout, *words).out) for words in ([], ["--modernise"]))
    for file, lines in plain.items():
        assert not lines - modern[file], f"{file}: --modernise leaves out what the patch does"
    assert "simple_knn" not in str(plain) and "simple_knn" in str(modern)

    assert dsmoe("patch", "apply", checkout, "--modernise").status == 0
    after = contents(checkout, record=False)
    assert lines_between(before, after) == modern
    for file in changed_files(before, after):
        compile(after[file][1], file, "exec")
    assert dsmoe("patch", "revert", checkout).status == 0
    assert contents(checkout) == before


def test_python_functions_do_what_the_commands_do(tmp_path, dsmoe):
    one, other = (make_checkout("taming", tmp_path / name) for name in ("one", "other"))
    before = contents(one)
    assert changed_lines(patches.diff(one)) == changed_lines(dsmoe("patch", "diff", other).out)
    patches.apply(str(one), modernise=False, trainer="taming")
    assert dsmoe("patch", "apply", other, "--trainer", "taming").status == 0
    assert contents(one, record=False) == contents(other, record=False) != before
    patches.revert(one)
    assert contents(one) == before


def test_the_module_is_the_command(tmp_path):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    command = [sys.executable, "-m", "diff_smoe_rasterization", "patch", "check", str(checkout)]
    result = subprocess.run(command, capture_output=True, text=True, env=environment(), cwd=tmp_path)
    assert result.returncode == 0 and "patchable" in result.stdout, result.stderr


FORMATS = {
    "crlf": lambda text: text.replace(b"\n", b"\r\n"),
    "crlf and bom": lambda text: b"\xef\xbb\xbf" + text.replace(b"\n", b"\r\n"),
    "no newline at the end": lambda text: text.rstrip(b"\n"),
    "tabs": lambda text: text.replace(b"    ", b"\t"),
    "blanks at ends of lines": lambda text: text.replace(b"\n\n", b"\n  \n").replace(b":\n", b":  \n"),
    "latin-1": lambda text: b"# -*- coding: latin-1 -*-\n# \xe9\n" + text,
}


@pytest.mark.parametrize("change", FORMATS.values(), ids=FORMATS)
def test_formats_and_modes_of_files_are_kept(change, tmp_path, dsmoe):
    checkout = make_checkout("3dgs-2023", tmp_path / "checkout")
    for file in ("train.py", "render.py", "arguments/__init__.py", "gaussian_renderer/__init__.py"):
        (checkout / file).write_bytes(change((checkout / file).read_bytes()))
    (checkout / "train.py").chmod(0o755)
    (checkout / "render.py").chmod(0o640)
    before = contents(checkout)
    assert dsmoe("patch", "apply", checkout).status == 0
    after = contents(checkout, record=False)
    assert len(changed_files(before, after)) == 4
    for file in changed_files(before, after):
        (old_mode, old), (new_mode, new) = before[file], after[file]
        assert new_mode == old_mode
        compile(new, file, "exec")
        assert new.startswith(b"\xef\xbb\xbf") == old.startswith(b"\xef\xbb\xbf")
        assert new.endswith(b"\n") == old.endswith(b"\n")
        assert new.count(b"\r\n") == (new.count(b"\n") if b"\r\n" in old else 0)
        gone = Counter(old.splitlines()) - Counter(new.splitlines())
        assert sum(gone.values()) <= 1, f"{file}: more lines gone than the import: {gone}"
    assert dsmoe("patch", "revert", checkout).status == 0
    assert contents(checkout) == before


def test_a_patched_checkout_can_be_moved(tmp_path, dsmoe):
    before = contents(make_checkout("c3dgs", tmp_path / "here"))
    assert dsmoe("patch", "apply", tmp_path / "here").status == 0
    shutil.move(str(tmp_path / "here"), str(tmp_path / "there"))
    assert ": patched" in dsmoe("patch", "check", tmp_path / "there").out
    assert dsmoe("patch", "revert", tmp_path / "there").status == 0
    assert contents(tmp_path / "there") == before
