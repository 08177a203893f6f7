"""What `dsmoe patch apply|check|diff|revert` prints."""
from __future__ import annotations

import sys
from argparse import Namespace
from typing import Any, Dict, Iterable

from . import engine


def apply(arguments: Namespace) -> int:
    """Patches, or with --dry-run shows what a patch would change."""
    if arguments.dry_run:
        planned = engine.plan(arguments.path, **_options(arguments))
        todo = engine.pending(planned)
        for name, data in todo.items():
            sys.stdout.write(engine.diff_of(name, (planned.root / name).read_bytes(), data))
        if todo:
            _print_notes(planned)
            return 0
    else:
        planned = engine.apply(arguments.path, **_options(arguments))
    verdict = planned.verdict
    if planned.written:
        print(f"{arguments.path}: patched ({verdict.trainer})")
        _print_lines(f"{change.name}: {', '.join(change.rules)}" for change in planned.changes)
        print("It knows --blend_mode and --background_gate now, and saves them in cfg_args; `dsmoe patch revert` takes "
              "the patch back.")
    else:
        written = "would be" if arguments.dry_run else "was"
        print(f"{arguments.path}: already patched ({verdict.trainer}); nothing {written} written")
        _print_lines(verdict.reasons)
    _print_lines(planned.notes)
    return 0


def check(arguments: Namespace) -> int:
    """Says in one word how the checkout is, and why."""
    planned = engine.inspect(arguments.path, **_options(arguments))
    verdict = planned.verdict
    print(f"{arguments.path}: {verdict}" + (f" ({verdict.trainer})" if verdict.trainer else ""))
    if verdict in ("patchable", "patched"):
        _print_lines((*verdict.reasons, *planned.notes))
        return 0
    print(f"dsmoe patch: error: {engine.refusal(verdict)}", file=sys.stderr)
    return 1


def diff(arguments: Namespace) -> int:
    """Shows what the patch changes, against the files as they were before any patch."""
    planned = engine.plan(arguments.path, **_options(arguments))
    for change in planned.changes:
        sys.stdout.write(engine.diff_of(change.name, change.before, change.after))
    if planned.verdict == "patched" and planned.record is None:
        print(f"{arguments.path}: is patched, but what it was before is not known without .dsmoe_patch: this is no "
              "diff of the patch", file=sys.stderr)
    _print_notes(planned)
    return 0


def revert(arguments: Namespace) -> int:
    """Puts every file back."""
    names = engine.revert(arguments.path)
    print(f"{arguments.path}: as it was before the patch ({len(names)} files)"
          + (f", with your edits of {', '.join(names.edited)}" if names.edited else ""))
    return 0


def _options(arguments: Namespace) -> Dict[str, Any]:
    return {name: getattr(arguments, name) for name in ("modernise", "trainer", "fuse")}


def _print_lines(lines: Iterable[str]) -> None:
    for line in lines:
        print("  " + line)


def _print_notes(planned: engine.Plan) -> None:
    for note in planned.notes:
        print(note, file=sys.stderr)
