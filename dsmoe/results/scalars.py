"""Numbers of a training for TensorBoard, in OUT/tensorboard; none are written if tensorboard is not installed."""
from __future__ import annotations

import glob
import importlib.util
import os
from typing import Any, List

FOLDER = "tensorboard"


def is_installed() -> bool:
    """Whether there is a tensorboard; it is not loaded for that."""
    return importlib.util.find_spec("tensorboard") is not None


class Scalars:
    """What TensorBoard shows of a run; without tensorboard it does nothing, and `active` is False."""

    def __init__(self, output: str, iteration: int, wanted: bool = True) -> None:
        """output: the run's folder. iteration: that the run goes on from; what was written later is not shown."""
        self._writer: Any = None
        if not wanted or not is_installed():
            return
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:  # a tensorboard that this torch does not know
            return
        self._writer = SummaryWriter(os.path.join(output, FOLDER), purge_step=iteration + 1)

    @property
    def active(self) -> bool:
        return self._writer is not None

    def add(self, iteration: int, **values: float) -> None:
        """Notes numbers by name; "__" in a name makes a group: test__psnr is shown as test/psnr."""
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(name.replace("__", "/"), value, iteration)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


def scalar_files(output: str) -> List[str]:
    """The files of earlier runs, by their paths in the run's folder; none if its folder for them is a link."""
    if os.path.islink(os.path.join(output, FOLDER)):
        return []
    found = glob.glob(os.path.join(glob.escape(output), FOLDER, "events.out.tfevents.*"))
    return [os.path.relpath(path, output) for path in found]
