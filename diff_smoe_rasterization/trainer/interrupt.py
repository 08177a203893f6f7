"""Ctrl-C that waits for the end of a training step, so that what is saved then is whole."""
from __future__ import annotations

import signal
import threading
from typing import Any


class DelayedInterrupt:
    """A context in which the first Ctrl-C sets `asked` and a second one raises KeyboardInterrupt at once.

    Does nothing outside the main thread, which alone may handle signals, or where Ctrl-C has a handler already.
    """

    def __init__(self) -> None:
        self.asked = False
        self._active = False

    def __enter__(self) -> "DelayedInterrupt":
        self._active = (threading.current_thread() is threading.main_thread()
                        and signal.getsignal(signal.SIGINT) is signal.default_int_handler)
        if self._active:
            signal.signal(signal.SIGINT, self._ask)
        return self

    def __exit__(self, *error: Any) -> None:
        if self._active:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _ask(self, number: int, frame: Any) -> None:
        self.asked = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
