"""PATH/.dsmoe_patch: the files as they were, and what they became. It is complete before the first file is patched.

    .dsmoe_patch/originals/NAME    the file as it was
    .dsmoe_patch/patched/NAME      the file as it became, by which the user's edits are told from the patch
    .dsmoe_patch/manifest.json     {"format", "version", "trainer", "options"}; written last, removed first
"""
from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any, Dict, Mapping, NamedTuple, Optional

from .source import PatchError

FOLDER = ".dsmoe_patch"
FORMAT = 1
PACKAGE = b"diff_smoe_rasterization"  # what a patched file imports from


class Record(NamedTuple):
    """The record of a checkout that was patched."""

    root: Path
    manifest: Mapping[str, Any]
    before: Mapping[str, bytes]
    after: Mapping[str, bytes]

    @classmethod
    def in_force(cls, root: Path) -> Optional[Record]:
        """Returns the record; None where the checkout has none, or none of its files is patched any more.

        Raises PatchError where it cannot be read.
        """
        if not (root / FOLDER / "manifest.json").exists():
            return None
        try:
            manifest = json.loads((root / FOLDER / "manifest.json").read_text(encoding="utf-8"))
            before, after = (_files(root / FOLDER / kind) for kind in ("originals", "patched"))
            if manifest["format"] != FORMAT or set(before) != set(after):
                raise ValueError(f"it is of another format than {FORMAT}, or has lost files")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise PatchError(f"{FOLDER}/manifest.json: the record of the patch is damaged ({error}); put the files "
                             f"back from your version control, then delete {FOLDER}") from None
        record = cls(root, manifest, before, after)
        return None if set(record.states().values()) <= {"original", "replaced", "gone"} else record

    @staticmethod
    def make(root: Path, before: Mapping[str, bytes], after: Mapping[str, bytes], **notes: Any) -> None:
        """Writes the record of a patch that is about to be made, while every file is the original."""
        for kind, files in (("originals", before), ("patched", after)):
            for name, data in files.items():
                copy = root / FOLDER / kind / name
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(data)
        (root / FOLDER / ".gitignore").write_text("*\n")
        unfinished = root / FOLDER / "manifest.part"
        unfinished.write_text(json.dumps({"format": FORMAT, **notes}) + "\n", encoding="utf-8")
        unfinished.replace(root / FOLDER / "manifest.json")

    def states(self) -> Dict[str, str]:
        """Returns of each file whether it is "original", "patched", or "cut", "changed", "replaced" or "gone" since."""
        return {name: self._state(name) for name in self.before}

    def _state(self, name: str) -> str:
        if not (self.root / name).is_file():
            return "gone"
        now, after = (self.root / name).read_bytes(), self.after[name]
        if now in (self.before[name], after):
            return "original" if now == self.before[name] else "patched"
        if after.startswith(now) or self.before[name].startswith(now):  # a kill while it was written
            return "cut"
        # One that imported this package and no longer does was replaced, as by git checkout.
        return "replaced" if PACKAGE in after and PACKAGE not in now else "changed"


def remove(root: Path) -> bool:
    """Removes the record, or what there is of one; returns whether there was something."""
    was_there = (root / FOLDER).exists()
    if was_there:
        (root / FOLDER / "manifest.json").unlink(missing_ok=True)
        shutil.rmtree(root / FOLDER)
    return was_there


def _files(folder: Path) -> Dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*"))
            if path.is_file()}
