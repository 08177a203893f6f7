"""Which processes of a training still answer: a stopped one holds up all others, and would do so without a word."""
from __future__ import annotations

import contextlib
import sys
import threading
import time
from typing import Any, Dict, List

BEAT = 10.0  # seconds between two beats
PATIENCE = 60.0  # seconds without a beat after which a process is said not to answer
KEY = "dsmoe/beats/"


class Heartbeat:
    """A thread that counts up this process's number in a store that all processes share, and reads those of the others.

    A context. Of the processes that answer, and did before, the first one prints on stderr which ones do not.
    """

    def __init__(self, store: Any, rank: int, size: int, beat: float = BEAT, patience: float = PATIENCE) -> None:
        """store: of torch.distributed, with a connection of its own. beat, patience: seconds."""
        self.store, self.rank, self.size = store, rank, size
        self.beat, self.patience = beat, patience
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(self, *error: Any) -> None:
        self._end.set()
        self._thread.join(self.patience)

    def _run(self) -> None:
        seen: Dict[int, int] = {}
        changed: Dict[int, float] = {}
        said: List[int] = []
        with contextlib.suppress(RuntimeError, OSError, ValueError):  # the store has ended, and with it the training
            while not self._end.wait(self.beat):
                self.store.add(KEY + str(self.rank), 1)
                now = time.monotonic()
                for rank in range(self.size):
                    count = self.store.add(KEY + str(rank), 0)
                    if count != seen.get(rank):
                        seen[rank], changed[rank] = count, now
                silent = [rank for rank in range(self.size) if now - changed[rank] > self.patience]
                if silent != said and min({*range(self.size)} - {*silent, *said}, default=0) == self.rank:
                    self._say(silent)
                said = silent

    def _say(self, silent: List[int]) -> None:
        many = ", ".join(map(str, silent))
        text = f"process{'es' if silent[1:] else ''} {many} of {self.size} {'have' if silent[1:] else 'has'} not " \
               f"answered for {self.patience:g} s: stopped, or without a connection; the others wait"
        print(f"dsmoe train: {text if silent else 'all processes answer again'}", file=sys.stderr, flush=True)
