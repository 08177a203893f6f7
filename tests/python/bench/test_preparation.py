"""What cells need is made, and made anew where what it was made of has changed."""
from __future__ import annotations

import importlib
import shutil
import subprocess
from pathlib import Path

import pytest
from PIL import Image

from diff_smoe_rasterization.benchmarks.suite import preparation

ROOM = {"views": 2, "width": 16, "height": 12, "points": 20, "supersampling": 1}


def made(results, **changes):
    """The folder of a made-up scene, and the size of its first image."""
    scene = {"name": "room", "path": None, "synthetic": {**ROOM, **changes}}
    folder = Path(preparation.made_scene(scene, str(results))["path"])
    return folder, Image.open(folder / "images" / "view_000.png").size


def test_a_made_up_scene_is_made_anew_where_its_parameters_have_changed(tmp_path):
    folder, size = made(tmp_path)
    assert size == (16, 12)
    (folder / "left").touch()
    assert made(tmp_path) == (folder, (16, 12)) and (folder / "left").exists()
    assert made(tmp_path, width=20) == (folder, (20, 12)) and not (folder / "left").exists()
    made(tmp_path, width=20, views=1)
    assert [path.name for path in (folder / "images").iterdir()] == ["view_000.png"]  # none of the earlier scene's


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A git checkout of a small trainer, and a function that commits all of it and returns the commit."""
    pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[1] / "patches"))
    folder = importlib.import_module("checkouts").make_checkout("3dgs-2023", tmp_path / "checkout")

    def git(*words):
        who = ["-c", "user.name=Somebody", "-c", "user.email=somebody@example.org"]
        return subprocess.run(["git", "-C", str(folder), *who, *words], check=True, stdout=subprocess.PIPE,
                              universal_newlines=True).stdout.strip()

    def commit():
        git("add", "--all")
        git("commit", "--quiet", "--message", "as it is")
        return git("rev-parse", "HEAD")

    git("init", "--quiet")
    return folder, commit


def prepared(path, results, **method):
    """The method as cells get it."""
    return preparation.prepared_method({"name": "3dgs-2023", "label": "ours", "variant": "patched", "path": str(path),
                                        **method}, str(results))


def test_the_copy_of_a_checkout_follows_it(checkout, tmp_path):
    folder, commit = checkout
    one = commit()
    method = prepared(folder, tmp_path / "results")
    copy = Path(method["path"])
    assert method["commit"] == one and "refused" not in method and copy.parent == tmp_path / "results" / "checkouts"
    (copy / "left").touch()
    assert prepared(folder, tmp_path / "results") == method and (copy / "left").exists()  # made once
    with open(folder / "train.py", "a") as file:
        file.write("# changed\n")
    method = prepared(folder, tmp_path / "results")  # not committed yet
    assert method["commit"] == one + "+" and (copy / "train.py").read_text().endswith("# changed\n")
    assert not (copy / "left").exists() and preparation.patches.check(copy) == "patched"
    two = commit()
    assert prepared(folder, tmp_path / "results") == {**method, "commit": two}


def test_a_copys_commits_are_those_of_what_was_copied(checkout, tmp_path):
    folder, commit = checkout
    one = commit()
    method = prepared(folder, tmp_path / "results", name="c3dgs", variant="unpatched", base=str(folder))
    assert (method["commit"], method["base_commit"]) == (one, one)
    assert "base_commit" not in prepared(folder, tmp_path / "results")
