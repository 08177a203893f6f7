from typing import NamedTuple

import numpy as np
import torch


class BasicPointCloud(NamedTuple):
    points: np.ndarray  # [N, 3]
    colors: np.ndarray  # [N, 3], 0 to 1


def getWorld2View2(R, t):
    """[4, 4] of a camera with axes R (columns, in the world) and translation t."""
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3], matrix[:3, 3] = R.T, t
    return matrix


def getProjectionMatrix(znear, zfar, fovX, fovY):
    """[4, 4], depth from 0 at znear to 1 at zfar."""
    depth = zfar / (zfar - znear)
    matrix = torch.zeros(4, 4)
    matrix[0, 0], matrix[1, 1] = 1 / np.tan(fovX / 2), 1 / np.tan(fovY / 2)
    matrix[2, 2], matrix[2, 3], matrix[3, 2] = depth, -depth * znear, 1
    return matrix
