"""What `dsmoe patch apply|check|diff|revert` prints."""
from __future__ import annotations

import argparse
import sys

from . import engine


def apply(arguments: argparse.Namespace) -> int:
    """Patches, or with --dry-run shows what a patch would change."""
    if arguments.dry_run:
        return diff(arguments)
    planned = engine.apply(arguments.path, arguments.modernise, arguments.trainer)
    verdict = planned.verdict
    if planned.written:
        print(f"{arguments.path}: patched ({verdict.trainer})")
        for change in planned.changes:
            print(f"  {change.name}: {', '.join(change.rules)}")
        print("It knows --blend_mode now, and saves it in cfg_args; `dsmoe patch revert` takes the patch back.")
    else:
        print(f"{arguments.path}: already patched ({verdict.trainer}); nothing was written")
        _print_lines(verdict.reasons)
    _print_lines(planned.notes)
    return 0


def check(arguments: argparse.Namespace) -> int:
    """Says in one word how the checkout is, and why."""
    verdict = engine.check(arguments.path)
    trainer = f" ({verdict.trainer})" if verdict.trainer else ""
    print(f"{arguments.path}: {verdict}{trainer}")
    if verdict in ("patchable", "patched"):
        _print_lines(verdict.reasons)
        return 0
    print(f"dsmoe patch: error: {engine.refusal(verdict)}", file=sys.stderr)
    return 1


def diff(arguments: argparse.Namespace) -> int:
    """Shows what the patch changes, against the files as they were before any patch."""
    planned = engine.plan(arguments.path, arguments.modernise, arguments.trainer)
    sys.stdout.write("".join(engine.diff_of(change) for change in planned.changes))
    for note in planned.notes:
        print(note, file=sys.stderr)
    return 0


def revert(arguments: argparse.Namespace) -> int:
    """Puts every file back."""
    names = engine.revert(arguments.path)
    print(f"{arguments.path}: as it was before the patch ({len(names)} files)")
    return 0


def _print_lines(lines) -> None:
    for line in lines:
        print("  " + line)
