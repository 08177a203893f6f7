"""Several trainings one after the other in one process of torchrun: one line of JSON for each, its options."""
from __future__ import annotations

import json
import sys

from dsmoe.options.config import TrainConfig
from dsmoe.system.group import join_group, leave_group
from dsmoe.train import train

group = join_group("cpu")
for record in map(json.loads, sys.argv[1:]):
    train(TrainConfig.of_record(record), progress=False, group=group)
leave_group(group)
