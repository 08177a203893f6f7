"""What cells need is made, and made anew if what it was made of has changed."""
import shutil
import subprocess
from pathlib import Path

import pytest
from checkouts import make_checkout
from PIL import Image

from dsmoe.bench import preparation


def test_a_made_up_scene_is_made_anew_where_its_parameters_have_changed(tmp_path):
    def made(**changes):
        scene = {"name": "room", "path": None, "synthetic": {"views": 2, "width": 16, "height": 12, "points": 20,
                                                             "supersampling": 1, **changes}}
        folder = Path(preparation.made_scene(scene, str(tmp_path))["path"])
        return folder, Image.open(folder / "images" / "view_000.png").size

    folder, size = made()
    assert size == (16, 12)
    (folder / "left").touch()
    assert made() == (folder, (16, 12)) and (folder / "left").exists()
    assert made(width=20, views=1) == (folder, (20, 12))
    assert [path.name for path in (folder / "images").iterdir()] == ["view_000.png"]  # none of the earlier scene's


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_the_copy_of_a_checkout_follows_it_and_has_its_commit(tmp_path):
    folder = make_checkout(tmp_path / "checkout")

    def git(*words):
        who = ["-c", "user.name=Somebody", "-c", "user.email=somebody@example.org"]
        return subprocess.check_output(["git", "-C", str(folder), *who, *words], text=True).strip()

    def prepared(**changes):
        return preparation.prepared_method({"name": "3dgs-2023", "label": "ours", "variant": "patched",
                                            "path": str(folder), **changes}, str(tmp_path / "results"))

    git("init", "--quiet")
    git("add", "--all")
    git("commit", "--quiet", "--message", "as it is")
    commit, method = git("rev-parse", "HEAD"), prepared()
    assert method["commit"] == commit and "refused" not in method and "base_commit" not in method
    copy = Path(method["path"])
    assert copy.parent == tmp_path / "results" / "checkouts" and preparation.patches.check(copy).state == "patched"
    with open(folder / "train.py", "a") as file:
        file.write("# changed\n")
    assert prepared()["commit"] == commit + "+" and (copy / "train.py").read_text().endswith("# changed\n")
    assert preparation.patches.check(folder).state == "patchable"
    method = prepared(name="c3dgs", variant="unpatched", base=str(folder))
    assert (method["commit"], method["base_commit"]) == (commit + "+", commit + "+")
