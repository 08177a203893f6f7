"""`dsmoe` as one process of torchrun. The second process dies in the iteration that DYING_AT names."""
from __future__ import annotations

import os
import sys

from dsmoe.cli import main
from dsmoe.distributed.trainer import BatchTrainer
from dsmoe.errors import TrainerError

step = BatchTrainer.step


def dying_step(self, *arguments):
    if self.group.rank == 1 and self.iteration + self.config.batch >= int(os.environ["DYING_AT"]):
        raise TrainerError("this process dies")
    return step(self, *arguments)


BatchTrainer.step = dying_step
sys.exit(main())
