import numpy as np
import torch
from torch import nn


class GrowingTensors:
    """Parameters of one row per point, whose optimizers follow when rows come and go.

    FIELDS names the attribute of every parameter group that has rows; other groups are left alone.
    """
    FIELDS = {}
    optimizers = ()

    def rebuild(self, new_rows, new_moments):
        """Replaces every parameter by new_rows(name, tensor), and Adam's moments of it by new_moments(tensor, rows)."""
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                if group["name"] not in self.FIELDS:
                    continue
                old, = group["params"]
                new = nn.Parameter(new_rows(group["name"], old.detach()))
                state = optimizer.state.pop(old, {})
                for key, value in state.items():
                    if torch.is_tensor(value) and value.shape == old.shape:
                        state[key] = new_moments(value, len(new))
                if state:
                    optimizer.state[new] = state
                group["params"] = [new]
                setattr(self, self.FIELDS[group["name"]], new)

    def keep_rows(self, mask):
        self.rebuild(lambda name, tensor: tensor[mask], lambda moment, rows: moment[mask])

    def add_rows(self, added):
        """added: {group name: new rows}; their moments start at zero."""
        def extended(moment, rows):
            return torch.cat([moment, moment.new_zeros(rows - len(moment), *moment.shape[1:])])

        self.rebuild(lambda name, tensor: torch.cat([tensor, added[name]]), extended)

    def save(self, path):
        np.savez(path, **{name: getattr(self, field).detach().cpu().numpy() for name, field in self.FIELDS.items()})

    def load(self, path, data_device):
        with np.load(path) as saved:
            for name, field in self.FIELDS.items():
                setattr(self, field, nn.Parameter(torch.tensor(saved[name], device=data_device)))
