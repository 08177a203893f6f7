"""What `dsmoe patch apply|check|diff|revert` prints."""
from __future__ import annotations

import sys
from argparse import Namespace
from typing import Any, Dict, Iterable

from . import engine


def apply(arguments: Namespace) -> int:
    """Patches, or with --dry-run shows what a patch would change."""
    make = engine.plan if arguments.dry_run else engine.apply
    planned = make(arguments.path, **_options(arguments))
    todo = engine.pending(planned) if arguments.dry_run else ()
    if todo:
        sys.stdout.write(engine.text_of(todo))
        _print_lines(planned.notes, sys.stderr, "")
    elif planned.written:
        print(f"{arguments.path}: patched ({planned.trainer})")
        _print_lines(f"{change.name}: {', '.join(change.rules)}" for change in planned.changes)
        print("It knows --blend_mode and --background_gate now, and saves them in cfg_args; `dsmoe patch revert` takes "
              "the patch back.")
        _print_lines(planned.notes)
    else:
        written = "would be" if arguments.dry_run else "was"
        print(f"{arguments.path}: already patched ({planned.trainer}); nothing {written} written")
        _print_lines((*planned.reasons, *planned.notes))
    return 0


def check(arguments: Namespace) -> int:
    """Says in one word how the checkout is, and why."""
    planned = engine.check(arguments.path, **_options(arguments))
    print(f"{arguments.path}: {planned.state}" + (f" ({planned.trainer})" if planned.trainer else ""))
    if planned.state in ("patchable", "patched"):
        _print_lines((*planned.reasons, *planned.notes))
        return 0
    print(f"dsmoe patch: error: {planned.refusal()}", file=sys.stderr)
    return 1


def diff(arguments: Namespace) -> int:
    """Shows what the patch changes, against the files as they were before any patch."""
    planned = engine.plan(arguments.path, **_options(arguments))
    sys.stdout.write(engine.text_of(planned.changes))
    if planned.state == "patched" and planned.record is None:
        print(f"{arguments.path}: is patched, but what it was before is not known without .dsmoe_patch: this is no "
              "diff of the patch", file=sys.stderr)
    _print_lines(planned.notes, sys.stderr, "")
    return 0


def revert(arguments: Namespace) -> int:
    """Puts every file back."""
    files = engine.revert(arguments.path)
    edited = [name for name, is_edited in files.items() if is_edited]
    print(f"{arguments.path}: as it was before the patch ({len(files)} files)"
          + (f", with your edits of {', '.join(edited)}" if edited else ""))
    return 0


def _options(arguments: Namespace) -> Dict[str, Any]:
    return {name: getattr(arguments, name) for name in ("modernise", "trainer", "fuse")}


def _print_lines(lines: Iterable[str], where: Any = None, indent: str = "  ") -> None:
    for line in lines:
        print(indent + line, file=where)
