"""`dsmoe train --gpus N`: the same command once for each GPU, started by torchrun."""
from __future__ import annotations

import os
import re
import subprocess
import sys
from typing import List, Sequence

from ..errors import ConfigError
from .children import die_with_parent

GPUS, AUTO = "--gpus", "auto"

PACKAGE = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))  # the folder that has dsmoe
# What each process runs: this package. `-m dsmoe` would take a dsmoe of the current folder, such as its source.
PROCESS = "import sys; sys.path.insert(0, sys.argv.pop(1)); from dsmoe.cli import main; sys.exit(main())"


def chosen_gpus(asked: str, device: str, batch: int) -> int:
    """How many GPUs of this machine a training takes. asked: a number, or `auto`: all, but no more than --batch.

    Raises ConfigError if it cannot take so many.
    """
    import torch

    number = int(asked) if re.fullmatch(r"\d{1,9}", asked, re.ASCII) else 0
    if number == 0 and asked != AUTO:
        raise ConfigError(f"{GPUS} is {asked}; it must be {AUTO} or a whole number, at least 1")
    if device != "cuda":
        raise ConfigError(f"{GPUS} is {asked} with --device {device}; it needs --device cuda")
    there = torch.cuda.device_count()
    if there == 0:
        raise ConfigError(f"{GPUS} is {asked}, and torch finds no GPU here; on CPUs start torchrun with --device cpu")
    if asked == AUTO:
        return min(there, batch)
    if number > there:
        raise ConfigError(f"{GPUS} is {asked}; it must be {AUTO}, or at most {there}: so many GPUs torch finds here")
    return number


def without_gpus(words: Sequence[str]) -> List[str]:
    """The words of a command without the option --gpus and its number."""
    kept: List[str] = []
    words = list(words)
    while words:
        word = words.pop(0)
        if word == GPUS:
            words.pop(0)
        elif not word.startswith(GPUS + "="):
            kept.append(word)
    return kept


def torchrun_command(gpus: int, words: Sequence[str]) -> List[str]:
    """What starts a `dsmoe` command, given by its words, in so many processes of this machine."""
    return [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", str(gpus), "--no_python",
            sys.executable, "-u", "-c", PROCESS, PACKAGE, *words]


def launch(gpus: int, words: Sequence[str]) -> int:
    """Runs the command in so many processes; returns torchrun's exit status once all have ended.

    If this process is killed, torchrun gets a SIGTERM, which it passes on: the processes save a checkpoint and end.
    """
    environment = {"OMP_NUM_THREADS": "1", **os.environ}
    process = subprocess.Popen(torchrun_command(gpus, words), env=environment, preexec_fn=die_with_parent)
    while True:
        try:
            return process.wait()
        except KeyboardInterrupt:  # torchrun has the signal too, and lets the processes save a checkpoint
            continue
