"""PATH/.dsmoe_patch: the originals, byte for byte, and what they became. Complete before the first file is patched.

    .dsmoe_patch/originals/NAME    the file as it was
    .dsmoe_patch/patched/NAME      the file as it became, by which `revert` tells the user's edits from the patch
    .dsmoe_patch/manifest.json     {"files": {name: {"before": sha256, "after": [sha256]}}, "complete": ..., ...}

A file is the original, patched, or changed by someone else: its checksum says which, whatever moment an interruption
came at. "complete" says that the last file was written: else it was an interruption, not the user, that left originals.
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
FORMAT = 1
PACKAGE = b"diff_smoe_rasterization"  # what a patched file imports from


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


class Record:
    """The record of a checkout that was patched."""

    def __init__(self, root: Path, manifest: Mapping[str, Any]) -> None:
        self.root, self.folder = root, root / FOLDER
        self.manifest, self.files = manifest, manifest["files"]

    @classmethod
    def load(cls, root: Path) -> Optional[Record]:
        """Returns the record, or None where the checkout has none. Raises PatchError where it cannot be read."""
        try:
            text = (root / FOLDER / "manifest.json").read_text(encoding="utf-8")
        except FileNotFoundError:
            return None
        except OSError as error:
            raise PatchError(f"{FOLDER}/manifest.json: the record of the patch cannot be read: {error}") from None
        try:
            record = cls(root, json.loads(text))
            if record.manifest["format"] != FORMAT:
                raise ValueError(f"its format is {record.manifest['format']!r}, not {FORMAT}")
            for name, hashes in record.files.items():
                if sha256(record.original(name)) != hashes["before"]:
                    raise ValueError(f"the original of {name} is not what was recorded")
            return record
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise PatchError(f"{FOLDER}/manifest.json: the record of the patch is damaged ({error}); put the files "
                             f"back from your version control, then delete {FOLDER}") from None

    @classmethod
    def in_force(cls, root: Path) -> Optional[Record]:
        """Returns the record, or None where the checkout has none or none of its files is patched any more."""
        record = cls.load(root)
        states = set(record.states().values()) if record else set()
        is_interrupted = states == {"original"} and not record.manifest["complete"]
        return record if is_interrupted or states & {"patched", "changed"} else None

    @classmethod
    def begin(cls, root: Path, before: Mapping[str, bytes], after: Mapping[str, bytes], notes: Mapping) -> Record:
        """Writes the record of a patch that is about to be made, while every file is the original."""
        for name, data in before.items():
            for folder, content in (("originals", data), ("patched", after[name])):
                copy = root / FOLDER / folder / name
                copy.parent.mkdir(parents=True, exist_ok=True)
                replace_file(root, copy, content)
        replace_file(root, root / FOLDER / ".gitignore", b"*\n")
        files = {name: {"before": sha256(data), "after": [sha256(after[name])]} for name, data in before.items()}
        record = cls(root, {"format": FORMAT, **notes, "files": files})
        record.note_complete(False)
        return record

    def note_complete(self, complete: bool) -> None:
        """Notes whether every file was written."""
        self.manifest = {**self.manifest, "complete": complete}
        replace_file(self.root, self.folder / "manifest.json", (json.dumps(self.manifest, indent=1) + "\n").encode())

    def original(self, name: str) -> bytes:
        return (self.folder / "originals" / name).read_bytes()

    def patched(self, name: str) -> Optional[bytes]:
        """The file as it became; None where the copy is of a patch that was interrupted."""
        path = self.folder / "patched" / name
        data = path.read_bytes() if path.is_file() else b""
        return data if sha256(data) == self.files[name]["after"][-1] else None

    def states(self) -> Dict[str, str]:
        """Returns of each file whether it is "original", "patched", or "changed", "replaced" or "gone" since."""
        return {name: self._state(name, hashes) for name, hashes in self.files.items()}

    def _state(self, name: str, hashes: Mapping) -> str:
        if not (self.root / name).is_file():
            return "gone"
        data = (self.root / name).read_bytes()
        now = sha256(data)
        if now == hashes["before"]:
            return "original"
        if now in hashes["after"]:
            return "patched"
        # One that imported this package and no longer does was replaced, as by git checkout.
        return "replaced" if PACKAGE in (self.patched(name) or b"") and PACKAGE not in data else "changed"

    def can_be_finished(self) -> bool:
        """Whether it is of a patch that was interrupted, and nobody has changed a file since."""
        return not self.manifest["complete"] and set(self.states().values()) <= {"patched", "original"}

    def take_back(self) -> None:
        """Puts the originals of all files that are patched back; an interruption leaves what can be finished."""
        self.note_complete(False)
        put_back(self.root, {name: self.original(name) for name in self.files})

    def remove(self) -> None:
        """Removes the record; the manifest first, without which the rest means nothing."""
        (self.folder / "manifest.json").unlink()
        shutil.rmtree(self.folder)


def put_back(root: Path, files: Mapping[str, bytes]) -> None:
    """Writes those files that are not these bytes."""
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
    """Writes a file at once or not at all. One that was there keeps mode and owner; a link's target is written.

    What an interruption leaves of it lies in the record's folder, and goes with it.
    """
    target = path.resolve()
    handle, temporary = tempfile.mkstemp(dir=str(root / FOLDER), prefix="unfinished_")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(str(target), temporary)
            if os.geteuid() == 0:  # in a container root patches a user's checkout
                shutil.chown(temporary, target.stat().st_uid, target.stat().st_gid)
        else:
            os.chmod(temporary, 0o644)
        os.replace(temporary, str(target))
    except BaseException:
        os.unlink(temporary)
        raise


def remove_rest(root: Path) -> bool:
    """Removes what is left of a patch that was interrupted before it changed a file; returns whether there was such."""
    folder = root / FOLDER
    for copy in (folder / "originals").rglob("*"):
        file = root / copy.relative_to(folder / "originals")
        if copy.is_file() and not (file.is_file() and file.read_bytes() == copy.read_bytes()):
            return False
    if folder.is_dir():
        shutil.rmtree(folder)
        return True
    return False
