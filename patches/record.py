"""PATH/.dsmoe_patch: the files as they were, and what they became. It is complete before the first file is patched.

    .dsmoe_patch/originals/NAME    the file as it was
    .dsmoe_patch/patched/NAME      the file as it became, by which `revert` tells the user's edits from the patch
    .dsmoe_patch/manifest.json     {"format", "version", "trainer", "options", "files": {NAME: {"before": sha256}}}

It is made beside and then renamed, so that it is there as a whole or not at all.
"""
from __future__ import annotations

import hashlib
import json
import os
import shutil
import stat
import tempfile
from pathlib import Path
from typing import Any, Dict, Iterable, Mapping, Optional

from .errors import PatchError

FOLDER = ".dsmoe_patch"
UNFINISHED = ".dsmoe_patch.unfinished"  # a record that is being made or removed
FORMAT = 1
PACKAGE = b"diff_smoe_rasterization"  # what a patched file imports from


class Record:
    """The record of a checkout that was patched."""

    def __init__(self, root: Path) -> None:
        """Raises OSError, ValueError, KeyError or TypeError where it cannot be read."""
        self.root, self.folder = root, root / FOLDER
        self.manifest = json.loads((self.folder / "manifest.json").read_text(encoding="utf-8"))
        if self.manifest["format"] != FORMAT:
            raise ValueError(f"its format is {self.manifest['format']!r}, not {FORMAT}")
        self.options = tuple(self.manifest["options"])
        self.before: Dict[str, bytes] = {}
        self.after: Dict[str, bytes] = {}  # without files whose copy is gone
        for name, hashes in self.manifest["files"].items():
            self.before[name] = (self.folder / "originals" / name).read_bytes()
            if hashlib.sha256(self.before[name]).hexdigest() != hashes["before"]:
                raise ValueError(f"the original of {name} is not what was recorded")
            if (self.folder / "patched" / name).is_file():
                self.after[name] = (self.folder / "patched" / name).read_bytes()

    @classmethod
    def load(cls, root: Path) -> Optional[Record]:
        """Returns the record, or None where the checkout has none. Raises PatchError where it cannot be read."""
        if not (root / FOLDER).exists():
            return None
        try:
            return cls(root)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise PatchError(f"{FOLDER}/manifest.json: the record of the patch is damaged ({error}); put the files "
                             f"back from your version control, then delete {FOLDER}") from None

    @classmethod
    def in_force(cls, root: Path) -> Optional[Record]:
        """Returns the record, or None where the checkout has none or none of its files is patched any more."""
        record = cls.load(root)
        return record if record and {"patched", "changed"} & set(record.states().values()) else None

    @staticmethod
    def make(root: Path, before: Mapping[str, bytes], after: Mapping[str, bytes], notes: Mapping[str, Any]) -> None:
        """Writes the record of a patch that is about to be made, while every file is the original."""
        shutil.rmtree(root / UNFINISHED, ignore_errors=True)
        for folder, files in (("originals", before), ("patched", after)):
            for name, data in files.items():
                copy = root / UNFINISHED / folder / name
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(data)
        (root / UNFINISHED / ".gitignore").write_text("*\n")
        files = {name: {"before": hashlib.sha256(data).hexdigest()} for name, data in before.items()}
        text = json.dumps({"format": FORMAT, **notes, "files": files}, indent=1)
        (root / UNFINISHED / "manifest.json").write_text(text + "\n", encoding="utf-8")
        os.replace(root / UNFINISHED, root / FOLDER)

    def states(self) -> Dict[str, str]:
        """Returns of each file whether it is "original", "patched", or "changed", "replaced" or "gone" since."""
        return {name: self._state(name) for name in self.before}

    def _state(self, name: str) -> str:
        if not (self.root / name).is_file():
            return "gone"
        now, after = (self.root / name).read_bytes(), self.after.get(name, b"")
        if now in (self.before[name], after):
            return "original" if now == self.before[name] else "patched"
        # One that imported this package and no longer does was replaced, as by git checkout.
        return "replaced" if PACKAGE in after and PACKAGE not in now else "changed"


def remove(root: Path) -> bool:
    """Removes the record, and what an interruption left of one; returns whether there was something."""
    was_there = (root / FOLDER).exists() or (root / UNFINISHED).exists()
    shutil.rmtree(root / UNFINISHED, ignore_errors=True)
    if (root / FOLDER).exists():
        os.replace(root / FOLDER, root / UNFINISHED)
        shutil.rmtree(root / UNFINISHED)
    return was_there


def write_files(root: Path, files: Mapping[str, bytes]) -> None:
    """Writes those files that are not these bytes, each at once or not at all, while there is a record."""
    for name, data in files.items():
        if (root / name).read_bytes() != data:
            replace_file(root, root / name, data)


def check_writable(root: Path, names: Iterable[str]) -> None:
    """Raises PatchError where a file, or one beside it, may not be written, or lies outside the checkout."""
    for name in names:
        target = (root / name).resolve()
        if root.resolve() not in target.parents:
            raise PatchError(f"{name}: is a link to {target}, outside the checkout; copy it into the checkout first")
        if not target.stat().st_mode & stat.S_IWUSR or not os.access(str(target), os.W_OK):
            raise PatchError(f"{name}: is read-only; make it writable first (chmod u+w)")
        if not os.access(str(target.parent), os.W_OK):
            raise PatchError(f"{name}: its folder {target.parent} is read-only; make it writable first (chmod u+w)")


def replace_file(root: Path, path: Path, data: bytes) -> None:
    """Writes a file, which keeps mode and owner; a link's target is written."""
    target = path.resolve()
    handle, temporary = tempfile.mkstemp(dir=str(root / FOLDER), prefix="unfinished_")
    with os.fdopen(handle, "wb") as file:
        file.write(data)
    shutil.copymode(str(target), temporary)
    if os.geteuid() == 0:  # in a container root patches a user's checkout
        shutil.chown(temporary, target.stat().st_uid, target.stat().st_gid)
    os.replace(temporary, str(target))
