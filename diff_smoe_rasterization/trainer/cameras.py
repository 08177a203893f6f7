"""Pinhole cameras and the matrices that a 3DGS rasterizer takes."""
from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Optional

import numpy as np
import torch

from ..settings import GaussianRasterizationSettings

# Clip range of the projection matrix. Nothing reads clip z (culling uses view depth), so it only has to be finite.
CLIP_NEAR = 0.01
CLIP_FAR = 100.0


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; view axes are x right, y down, z forward, in world units.

    Pixel coordinates are COLMAP's: the centre of the top left pixel is (0.5, 0.5).
    """

    name: str
    rotation: np.ndarray  # [3, 3] world to view: x_view = rotation @ x_world + translation
    translation: np.ndarray  # [3]
    fx: float  # pixels
    fy: float
    cx: float  # principal point, pixels
    cy: float
    width: int
    height: int

    @property
    def center(self) -> np.ndarray:
        """[3] the camera's position in the world."""
        return -self.rotation.T @ self.translation

    def resized(self, width: int, height: int) -> "Camera":
        """The same view at another image size; intrinsics scale with the axes."""
        sx, sy = width / self.width, height / self.height
        return dataclasses.replace(self, fx=self.fx * sx, cx=self.cx * sx, fy=self.fy * sy, cy=self.cy * sy,
                                   width=width, height=height)

    def centred(self) -> "Camera":
        """The same view with the principal point moved to the image centre."""
        return dataclasses.replace(self, cx=self.width / 2, cy=self.height / 2)

    def world_to_view(self) -> np.ndarray:
        """[4, 4] float64, acting on column vectors."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return matrix

    def view_to_clip(self) -> np.ndarray:
        """[4, 4] float64 perspective projection with the principal point, acting on column vectors.

        The rasterizer puts NDC x at pixel index ((x + 1) width - 1) / 2, so that a point at fx X/Z + cx (COLMAP's
        coordinates, half a pixel above the index) needs x = 2 fx/width X/Z + 2 cx/width - 1; y likewise.
        """
        matrix = np.zeros((4, 4))
        matrix[0, 0] = 2 * self.fx / self.width
        matrix[1, 1] = 2 * self.fy / self.height
        matrix[0, 2] = 2 * self.cx / self.width - 1
        matrix[1, 2] = 2 * self.cy / self.height - 1
        matrix[2, 2] = CLIP_FAR / (CLIP_FAR - CLIP_NEAR)
        matrix[2, 3] = -CLIP_FAR * CLIP_NEAR / (CLIP_FAR - CLIP_NEAR)
        matrix[3, 2] = 1.0
        return matrix

    def settings(self, background: torch.Tensor, sh_degree: int, blend_mode: str,
                 antialiasing: bool = False, scale_modifier: float = 1.0,
                 dtype: Optional[torch.dtype] = None) -> GaussianRasterizationSettings:
        """Rasterization settings of this camera, on the background's device.

        background: [3]. dtype: of the matrices, by default the background's.
        """
        dtype = dtype or background.dtype

        def tensor(array: np.ndarray) -> torch.Tensor:
            return torch.tensor(np.ascontiguousarray(array), dtype=dtype, device=background.device)

        view = self.world_to_view()
        return GaussianRasterizationSettings(
            image_height=self.height,
            image_width=self.width,
            tanfovx=self.width / (2 * self.fx),
            tanfovy=self.height / (2 * self.fy),
            bg=background,
            scale_modifier=scale_modifier,
            viewmatrix=tensor(view.T),
            projmatrix=tensor((self.view_to_clip() @ view).T),
            sh_degree=sh_degree,
            campos=tensor(self.center),
            antialiasing=antialiasing,
            blend_mode=blend_mode,
        )


def scene_extent(centers: np.ndarray) -> float:
    """The scale of a scene as 3DGS takes it: 1.1 times the largest distance of a camera from their mean.

    centers: [V, 3] positions of the training cameras. A single camera (or several in one place) gives 1.0,
    where the formula would give 0 and stop all positions.
    """
    radius = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()) * 1.1
    # Centres computed from poses differ by rounding even where they are one place.
    return radius if radius > 1e-6 * max(1.0, float(np.abs(centers).max())) else 1.0
