"""PATH/.dsmoe_patch: the originals, byte for byte, and a manifest of what was changed. Written before any file is.

    .dsmoe_patch/manifest.json     {"files": {name: {"before": sha256, "after": [...], ...}}, "trainer": ..., ...}
    .dsmoe_patch/originals/NAME    the file as it was
    .dsmoe_patch/patched/NAME      the file as it became, by which `revert` tells the user's edits from the patch

The last of "after" is what the file became; earlier ones are of a patch that this one took over from, so that whatever
moment an interruption came at, each file is known to be the original, patched, or changed by someone else.
"imports_ours" says that it then imports this package: one that no longer does was replaced, as by git checkout.
"complete" says that the last file was written: else it was an interruption, not the user, that left originals.
"""
from __future__ import annotations

import hashlib
import json
import os
import shutil
import stat
import tempfile
from pathlib import Path
from typing import Dict, Mapping, Optional

from .errors import PatchError

FOLDER = ".dsmoe_patch"
FORMAT = 1
PACKAGE = b"diff_smoe_rasterization"  # what a patched file imports from


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


class Record:
    """The record of a checkout that was patched."""

    def __init__(self, root: Path, manifest: Mapping) -> None:
        self.folder, self.manifest = root / FOLDER, manifest
        self.root, self.files = root, manifest["files"]

    @classmethod
    def in_force(cls, root: Path) -> Optional[Record]:
        """Returns the record, or None where the checkout has none or none of its files is patched any more."""
        record = cls.load(root)
        if record is None:
            return None
        states = set(record.states().values())
        is_pending = not record.manifest["complete"] and states == {"original"}
        return record if is_pending or states & {"patched", "changed"} else None

    @classmethod
    def load(cls, root: Path) -> Optional[Record]:
        """Returns the record, or None where the checkout has none. Raises PatchError where it cannot be read."""
        path = root / FOLDER / "manifest.json"
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return None
        except OSError as error:
            raise PatchError(f"{FOLDER}/manifest.json: the record of the patch cannot be read: {error}") from None
        try:
            manifest = json.loads(text)
            if manifest["format"] != FORMAT:
                raise ValueError(f"its format is {manifest['format']!r}, not {FORMAT}")
            record = cls(root, manifest)
            for name, hashes in record.files.items():
                if sha256(record.original(name)) != hashes["before"]:
                    raise ValueError(f"the original of {name} is not what was recorded")
            return record
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise PatchError(f"{FOLDER}/manifest.json: the record of the patch is damaged ({error}); put the files "
                             f"back from your version control, then delete {FOLDER}") from None

    @classmethod
    def write(cls, root: Path, originals: Mapping[str, bytes], after: Mapping[str, bytes], notes: Mapping) -> Record:
        """Writes the record of a patch that is about to be made; of one that was made before, it keeps the hashes."""
        earlier = cls.load(root)
        files = {}
        for name, data in originals.items():
            before = earlier.files[name]["after"] if earlier and name in earlier.files else []
            new = sha256(after[name])
            files[name] = {"before": sha256(data), "after": [known for known in before if known != new] + [new],
                           "imports_ours": PACKAGE in after[name]}
            for folder, content in (("originals", data), ("patched", after[name])):
                copy = root / FOLDER / folder / name
                copy.parent.mkdir(parents=True, exist_ok=True)
                replace_file(root, copy, content)
        replace_file(root, root / FOLDER / ".gitignore", b"*\n")
        record = cls(root, {"format": FORMAT, "complete": False, **notes, "files": files})
        record._write_manifest()
        return record

    def completed(self) -> None:
        """Notes that every file was written."""
        self.manifest = {**self.manifest, "complete": True}
        self._write_manifest()

    def _write_manifest(self) -> None:
        replace_file(self.root, self.folder / "manifest.json", (json.dumps(self.manifest, indent=1) + "\n").encode())

    def original(self, name: str) -> bytes:
        return (self.folder / "originals" / name).read_bytes()

    def patched(self, name: str) -> Optional[bytes]:
        """The file as it became; None where an earlier version wrote the record, or where the copy is another."""
        try:
            data = (self.folder / "patched" / name).read_bytes()
        except OSError:
            return None
        return data if sha256(data) == self.files[name]["after"][-1] else None

    def states(self) -> Dict[str, str]:
        """Returns of each file whether it is "original", "patched", or "changed", "replaced" or "gone" since."""
        return {name: self._state(name, hashes) for name, hashes in self.files.items()}

    def can_be_finished(self) -> bool:
        """Whether it is of a patch that was interrupted, and nobody has changed a file since."""
        return not self.manifest["complete"] and set(self.states().values()) <= {"patched", "original"}

    def _state(self, name: str, hashes: Mapping) -> str:
        try:
            data = (self.root / name).read_bytes()
        except FileNotFoundError:
            return "gone"
        now = sha256(data)
        if now == hashes["before"]:
            return "original"
        if now in hashes["after"]:
            return "patched"
        return "replaced" if hashes.get("imports_ours") and PACKAGE not in data else "changed"

    def remove(self) -> None:
        """Removes the record; the manifest first, without which the rest means nothing."""
        (self.folder / "manifest.json").unlink()
        shutil.rmtree(self.folder)


def check_writable(root: Path, name: str) -> None:
    """Raises PatchError where a file, or one beside it, may not be written, or lies outside the checkout."""
    path = root / name
    target = path.resolve()
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
    copies = [path for path in (folder / "originals").rglob("*") if path.is_file()]

    def is_original(copy: Path) -> bool:
        file = root / copy.relative_to(folder / "originals")
        return file.is_file() and file.read_bytes() == copy.read_bytes()

    if not folder.is_dir() or not all(is_original(copy) for copy in copies):
        return False
    shutil.rmtree(folder)
    return True
