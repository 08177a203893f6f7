"""What `dsmoe patch apply|check|diff|revert` prints."""
from __future__ import annotations

import sys
from argparse import Namespace
from typing import Any, Dict

from . import engine


def apply(arguments: Namespace) -> int:
    """Patches."""
    planned = engine.apply(**_options(arguments))
    print(f"{arguments.path}: {'patched' if planned.written else 'already patched'} ({planned.trainer})")
    sys.stdout.writelines(f"  {name}: {', '.join(dict.fromkeys(rules))}\n" for name, rules in planned.rules.items())
    print("It knows --blend_mode and --background_gate, and saves them in cfg_args; `dsmoe patch revert` undoes it.")
    sys.stdout.writelines(f"  {note}\n" for note in planned.notes)
    return 0


def check(arguments: Namespace) -> int:
    """Says in one word how the checkout is, and why."""
    planned = engine.check(**_options(arguments))
    options = "".join(f", --{option}" for option in planned.applied)
    print(f"{arguments.path}: {planned.state}" + (f" ({planned.trainer}{options})" if planned.trainer else ""))
    sys.stdout.writelines(f"  {line}\n" for line in (*planned.reasons, *planned.notes))
    return 0 if planned.state in ("patchable", "patched") else 1


def diff(arguments: Namespace) -> int:
    """Shows what the patch changes, against the files as they were before any patch."""
    sys.stdout.write(engine.diff(**_options(arguments)))
    return 0


def revert(arguments: Namespace) -> int:
    """Takes the patch out of every file."""
    files = engine.revert(arguments.path)
    print(f"{arguments.path}: as it was before the patch ({len(files)} files); your own edits stay")
    return 0


def _options(arguments: Namespace) -> Dict[str, Any]:
    return {name: getattr(arguments, name) for name in ("path", "modernise", "trainer", "fuse")}
