"""What `dsmoe patch apply|check|diff|revert` prints."""
from __future__ import annotations

import argparse
import shlex
import sys
from typing import List, Tuple

from . import engine
from .errors import PatchError


def apply(arguments: argparse.Namespace) -> int:
    """Patches, or with --dry-run shows what a patch would change."""
    if arguments.dry_run:
        planned = engine.plan(arguments.path, arguments.modernise, arguments.trainer, arguments.fuse)
        todo = engine.pending(planned)
        for name, data in todo.items():
            sys.stdout.write(engine.diff_of(name, (planned.root / name).read_bytes(), data))
        if todo:
            _print_notes(planned)
            return 0
    else:
        planned = engine.apply(arguments.path, arguments.modernise, arguments.trainer, arguments.fuse)
    verdict = planned.verdict
    if planned.written:
        print(f"{arguments.path}: patched ({verdict.trainer})")
        for change in planned.changes:
            print(f"  {change.name}: {', '.join(change.rules)}")
        print("It knows --blend_mode and --background_gate now, and saves them in cfg_args; `dsmoe patch revert` takes "
              "the patch back.")
    else:
        written = "would be" if arguments.dry_run else "was"
        print(f"{arguments.path}: already patched ({verdict.trainer}); nothing {written} written")
        _print_lines(verdict.reasons)
    _print_lines(_remarks(planned, arguments))
    return 0


def check(arguments: argparse.Namespace) -> int:
    """Says in one word how the checkout is, and why."""
    planned = engine.inspect(arguments.path, arguments.modernise, arguments.trainer, arguments.fuse)
    verdict = planned.verdict
    trainer = f" ({verdict.trainer})" if verdict.trainer else ""
    print(f"{arguments.path}: {verdict}{trainer}")
    if verdict in ("patchable", "patched"):
        _print_lines((*verdict.reasons, *_remarks(planned, arguments)))
        return 0
    print(f"dsmoe patch: error: {engine.refusal(verdict)}", file=sys.stderr)
    return 1


def _remarks(planned: engine.Plan, arguments: argparse.Namespace) -> List[str]:
    """The notes on a checkout, and what to type where rules that an option asks for are still not applied."""
    pending = [] if planned.written else [rule.option for rule in planned.requested if rule.pending]
    return [*planned.notes] + ([_how_to_apply(tuple(dict.fromkeys(pending)), planned, arguments)] if pending else [])


def _how_to_apply(options: Tuple[str, ...], planned: engine.Plan, arguments: argparse.Namespace) -> str:
    """Says what to type for rules of these options that are not applied, or why they cannot be."""
    try:
        is_written = bool(engine.pending(planned))
    except PatchError as error:
        return f"{', '.join(options)}: cannot be applied as it is: {error}"
    trainer = ["--trainer", arguments.trainer] if arguments.trainer else []
    command = " ".join(map(shlex.quote, ["dsmoe", "patch", "apply", *engine.words_of(options).split(), *trainer,
                                         str(arguments.path)]))
    before = "" if is_written else "undo your edit of patched files, then "
    return f"{', '.join(options)}: to apply what is not, {before}type: {command}"


def diff(arguments: argparse.Namespace) -> int:
    """Shows what the patch changes, against the files as they were before any patch."""
    planned = engine.plan(arguments.path, arguments.modernise, arguments.trainer, arguments.fuse)
    for change in planned.changes:
        sys.stdout.write(engine.diff_of(change.name, change.before, change.after))
    if planned.verdict == "patched" and planned.record is None:
        print(f"{arguments.path}: is patched, but what it was before is not known without .dsmoe_patch: this is no "
              "diff of the patch", file=sys.stderr)
    _print_notes(planned)
    return 0


def revert(arguments: argparse.Namespace) -> int:
    """Puts every file back."""
    names = engine.revert(arguments.path)
    print(f"{arguments.path}: as it was before the patch ({len(names)} files)"
          + (f", with your edits of {', '.join(names.edited)}" if names.edited else ""))
    return 0


def _print_lines(lines) -> None:
    for line in lines:
        print("  " + line)


def _print_notes(planned: engine.Plan) -> None:
    for note in planned.notes:
        print(note, file=sys.stderr)
