from typing import NamedTuple

import numpy as np
import torch


class Cloud(NamedTuple):
    points: np.ndarray  # [N, 3]
    colors: np.ndarray  # [N, 3], 0 to 1


def world_to_view(R, t):
    """[4, 4] of a camera with axes R (columns, in the world) and translation t."""
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3], matrix[:3, 3] = R.T, t
    return matrix


def perspective(near, far, fov_x, fov_y):
    """[4, 4], depth from 0 at `near` to 1 at `far`."""
    depth = far / (far - near)
    matrix = torch.zeros(4, 4)
    matrix[0, 0], matrix[1, 1] = 1 / np.tan(fov_x / 2), 1 / np.tan(fov_y / 2)
    matrix[2, 2], matrix[2, 3], matrix[3, 2] = depth, -depth * near, 1
    return matrix
