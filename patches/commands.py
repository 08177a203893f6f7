"""What `dsmoe patch apply|check|diff|revert` prints."""
from __future__ import annotations

import sys
from typing import Any

from . import engine


def apply(path: str, **options: Any) -> int:
    """Patches."""
    planned = engine.apply(path, **options)
    print(f"{path}: {'patched' if planned.written else 'already patched'} ({planned.trainer})")
    sys.stdout.writelines(f"  {name}: {', '.join(dict.fromkeys(rules))}\n" for name, rules in planned.rules.items())
    print("It knows --blend_mode and --background_gate, and saves them in cfg_args; `dsmoe patch revert` undoes it.")
    sys.stdout.writelines(f"  {note}\n" for note in planned.notes)
    return 0


def check(path: str, **options: Any) -> int:
    """Says in one word how the checkout is, and why."""
    planned = engine.check(path, **options)
    applied = "".join(f", --{option}" for option in planned.applied)
    print(f"{path}: {planned.state}" + (f" ({planned.trainer}{applied})" if planned.trainer else ""))
    sys.stdout.writelines(f"  {line}\n" for line in (*planned.reasons, *planned.notes))
    return 0 if planned.state in ("patchable", "patched", "supported") else 1


def diff(path: str, **options: Any) -> int:
    """Shows what the patch changes, against the files as they were before any patch."""
    sys.stdout.write(engine.diff(path, **options))
    return 0


def revert(path: str) -> int:
    """Takes the patch out of every file."""
    files = engine.revert(path)
    print(f"{path}: as it was before the patch ({len(files)} files); your own edits stay")
    return 0
