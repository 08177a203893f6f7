"""A command's output folder: new, empty or its own; one run at a time is at work there; what it wrote is recorded.

OUT/.dsmoe.lock is locked while a run is at work and free after it, however it ended. OUT/.dsmoe.json says which command
wrote which files: no others are replaced or removed, unless --overwrite asks for it. Only regular files ever are, and
none to which a link leads out of OUT.
"""
from __future__ import annotations

import json
import os
import platform
import shlex
from contextlib import contextmanager
from typing import IO, Collection, Iterator, List, NamedTuple, Optional

from ..errors import TrainerError
from .files import PART, check_output, is_file, write_json_atomically

try:
    import fcntl
except ImportError:  # Windows: nobody is kept away
    fcntl = None  # type: ignore[assignment]

LOCK_NAME = ".dsmoe.lock"
RECORD_NAME = ".dsmoe.json"


class Record(NamedTuple):
    """What a command says of the files that it wrote into a folder."""

    subject: str  # what they show, such as a scene's folder
    files: List[str]  # their paths in the folder


def make_folder(path: str) -> None:
    """Makes a folder if it is not there. Raises TrainerError if nothing can be written in it."""
    reason = ""
    try:
        os.makedirs(path, exist_ok=True)
    except OSError as error:
        reason = f" ({error.strerror})"
    if reason or not os.access(path, os.W_OK | os.X_OK):
        raise TrainerError(f"{path}: nothing can be written there{reason}; choose another folder with -o")


def locked(path: str, shared: bool = False) -> IO[str]:
    """The file, open and locked: exclusively, or shared with other processes. Raises TrainerError if it is taken.

    A file system that knows no locks keeps nobody away.
    """
    file = open(os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666), "r+", encoding="utf-8")
    try:
        if fcntl:
            fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError as error:
        with file:
            holder = file.read().strip()
        raise TrainerError(f"{os.path.dirname(path) or '.'}: another run is at work there"
                           f"{f' ({holder})' if holder else ''}; wait for its end, or choose another folder") from error
    except OSError:
        pass
    if not shared:
        file.truncate(0)
        file.write(f"process {os.getpid()} on {platform.node()}\n")
        file.flush()
    return file


@contextmanager
def only_one(folder: str) -> Iterator[IO[str]]:
    """Keeps a second run away from the folder; yields the lock. Raises TrainerError, naming process and host."""
    with locked(os.path.join(folder, LOCK_NAME)) as file:
        yield file


def check_there(folder: str, lock: IO[str]) -> None:
    """Raises TrainerError if the folder is no longer the one whose lock is held: moved, removed or replaced."""
    path = os.path.join(folder, LOCK_NAME)
    try:
        if os.path.samestat(os.stat(path), os.fstat(lock.fileno())):
            return
    except OSError:
        pass
    try:  # Linux knows where the lock is now
        now = os.readlink(f"/proc/self/fd/{lock.fileno()}")
    except OSError:
        now = ""
    if os.path.isfile(now):
        now = os.path.dirname(now)
        raise TrainerError(f"{folder} has been moved to {now} during the training; `dsmoe train --resume -o "
                           f"{shlex.quote(now)}` continues from its last checkpoint there")
    raise TrainerError(f"{folder} has been removed during the training; what is not saved is lost")


def read_record(folder: str, command: str) -> Optional[Record]:
    """What the command recorded in the folder; None if there is no record.

    Raises TrainerError if it is another command's, or damaged, or names a file to which a link leads.
    """
    path = os.path.join(folder, RECORD_NAME)
    if not is_file(path):
        return None
    try:
        with open(path, encoding="utf-8") as file:
            found = json.load(file)
        if not (isinstance(found, dict) and isinstance(found.get("command"), str) and isinstance(found.get("of"), str)
                and isinstance(found.get("files"), list) and all(isinstance(name, str) for name in found["files"])):
            raise ValueError("it must hold `command`, `of` and a list `files` of texts")
        writer, record = found["command"], Record(found["of"], found["files"])
        if not all(os.path.normpath(os.path.join(os.sep, name)) == os.sep + name and "\0" not in name
                   for name in record.files):
            raise ValueError("it names files elsewhere")
    except (ValueError, RecursionError) as error:
        raise TrainerError(f"{path}: not a record of what was written ({error}); choose another folder") from error
    if writer != command:
        raise TrainerError(f"{folder} holds what {writer} wrote; choose another folder with -o")
    check_inside(folder, record.files)
    return record


def check_inside(folder: str, names: Collection[str]) -> None:
    """Raises TrainerError if a link lies on the way from the folder to one of its files."""
    for parent in sorted({os.path.dirname(name) for name in names}):
        path = os.path.join(folder, parent)
        real = os.path.realpath(path)
        if real != os.path.normpath(os.path.join(os.path.realpath(folder), parent)):
            raise TrainerError(f"{path} leads to {real} by a link; nothing is written or removed there: choose another "
                               "folder with -o")


def own_record(folder: str, command: str, overwrite: bool = False, folders: Collection[str] = ()) -> Record:
    """What the command recorded in the folder; an empty record if there is no folder, or nothing in it.

    overwrite: other things may be in it. folders: those in it that the command writes into. Raises TrainerError if
    something is in it that the command has not recorded as its own, and if a link stands for one of the folders.
    """
    record = read_record(folder, command)
    check_inside(folder, [os.path.join(name, "a") for name in folders])
    if record is None and not overwrite:
        refuse_others(folder, command)
    return record or Record("", [])


def refuse_others(folder: str, command: str, remedy: str = "") -> None:
    """Raises TrainerError if something is in a folder without a record: the command has not written it.

    A lock, and what a killed process has left of a file, may be there. remedy: another one, for that error.
    """
    there = sorted(name for name in os.listdir(folder) if name != LOCK_NAME and not name.startswith(PART)
                   ) if os.path.isdir(folder) else []
    if there:
        raise TrainerError(f"{folder} is not empty ({there[0]}), and nothing says that {command} wrote it; choose a "
                           f"new or empty folder with -o{remedy}")


def write_record(folder: str, command: str, record: Record, earlier: Collection[str], overwrite: bool = False) -> None:
    """Records what is about to be written, and removes what of `earlier` is not.

    earlier: files that the command has written before. Raises TrainerError if another file is in the way, which
    `overwrite` lets be replaced, and if what is there is not a regular file.
    """
    check_inside(folder, record.files)
    for name in record.files:
        path = os.path.join(folder, name)
        check_output(path)
        if name not in earlier and os.path.lexists(path) and not overwrite:
            raise TrainerError(f"{path} is there, and nothing says that {command} wrote it; "
                               "move it, or choose another folder with -o")
    remove_files(folder, {*earlier} - {*record.files})
    write_json_atomically(os.path.join(folder, RECORD_NAME),
                          {"command": command, "of": record.subject, "files": record.files})


def remove_files(folder: str, names: Collection[str]) -> None:
    """Removes regular files of the folder that are there, and folders in it that are empty then; links stay.

    Raises TrainerError, and removes nothing, if a link leads to one of them.
    """
    check_inside(folder, names)
    for name in names:
        path = os.path.join(folder, name)
        if not os.path.islink(path) and os.path.isfile(path):
            os.remove(path)
        parent = os.path.dirname(name)
        while parent:
            try:
                os.rmdir(os.path.join(folder, parent))
            except OSError:  # not empty, a link, or not there
                break
            parent = os.path.dirname(parent)
