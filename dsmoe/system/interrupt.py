"""Ctrl-C, SIGTERM and SIGHUP that wait for the end of a training step, so that what is saved then is whole."""
from __future__ import annotations

import signal
import threading
from typing import Any, Dict, Optional


class Terminated(KeyboardInterrupt):
    """A signal has asked for the end: SIGTERM, as a queue's time limit does, or SIGHUP, as a terminal that closes."""

    def __init__(self, number: int = signal.SIGTERM) -> None:
        super().__init__()
        self.number = number


def exit_status(stop: KeyboardInterrupt) -> int:
    """What a command returns that ends so: 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP."""
    return 128 + (stop.number if isinstance(stop, Terminated) else signal.SIGINT)


class PromptInterrupt:
    """A context in which SIGTERM and SIGHUP end a command as Ctrl-C does: what removes unfinished files still runs.

    It leaves alone what `DelayedInterrupt` does.
    """

    def __enter__(self) -> None:
        self._usual: Dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):
                if signal.getsignal(number) == signal.SIG_DFL:
                    self._usual[number] = signal.signal(number, self._stop)

    def __exit__(self, *error: Any) -> None:
        for number, handler in self._usual.items():
            signal.signal(number, handler)

    def _stop(self, number: int, frame: Any) -> None:
        self.__exit__()  # a second one ends the process
        raise Terminated(number)


class DelayedInterrupt:
    """A context in which the first Ctrl-C, SIGTERM or SIGHUP sets `asked`; a second one acts at once, as elsewhere.

    Does nothing outside the main thread, since only that may handle signals, and leaves a signal that has a handler of
    somebody else's, as SIGHUP under nohup.
    """

    def __init__(self, patient: bool = False) -> None:
        """patient: a second signal does nothing. Who ends a job may signal torchrun and its processes, to which
        torchrun passes the signal on; it kills them after half a minute.
        """
        self.patient = patient
        self.asked: Optional[KeyboardInterrupt] = None  # raised after everything is saved
        self._usual: Dict[int, Any] = {}

    def __enter__(self) -> DelayedInterrupt:
        if threading.current_thread() is threading.main_thread():
            usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
            if hasattr(signal, "SIGHUP"):
                usual[signal.SIGHUP] = signal.SIG_DFL
            self._usual = {number: handler for number, handler in usual.items() if signal.getsignal(number) == handler}
        for number in self._usual:
            signal.signal(number, self._ask)
        return self

    def __exit__(self, *error: Any) -> None:
        for number, handler in self._usual.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: Any) -> None:
        self.asked = KeyboardInterrupt() if number == signal.SIGINT else Terminated(number)
        if not self.patient:
            self.__exit__()
