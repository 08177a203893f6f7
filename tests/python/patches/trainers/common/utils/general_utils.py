import random

import numpy as np
import torch


def safe_state(silent):
    """Seeds every generator; `silent` is there for the sake of its callers."""
    for seed in (torch.manual_seed, np.random.seed, random.seed):
        seed(0)


def inverse_sigmoid(y):
    return torch.log(y) - torch.log1p(-y)


def get_expon_lr_func(lr_init, lr_final, max_steps=1):
    """A rate that falls from lr_init to lr_final by the same factor in every step."""
    def rate(step):
        share = min(max(step / max_steps, 0.0), 1.0)
        return lr_init ** (1.0 - share) * lr_final ** share

    return rate


def build_rotation(quaternions):
    """[N, 4] (w, x, y, z) to [N, 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quaternions).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).view(-1, 3, 3)


def strip_symmetric(matrices):
    """[N, 3, 3] symmetric to [N, 6]: xx, xy, xz, yy, yz, zz."""
    row, column = torch.triu_indices(3, 3)
    return matrices[:, row, column]


def build_covariance(scales, quaternions):
    """[N, 6] of the ellipsoids with these axes."""
    axes = build_rotation(quaternions) * scales[:, None, :]
    return strip_symmetric(axes @ axes.transpose(1, 2))
