"""From a calibrated camera to the settings of a rendering."""
from __future__ import annotations

import math
from typing import Any, Optional, Sequence, Tuple

import torch

from .settings import GaussianRasterizationSettings, numbers_of, resolve_blend_mode, resolve_lens, resolve_shutter

# Clip range of the projection matrix. Nothing reads clip z (culling uses view depth), so it only has to be finite.
CLIP_NEAR = 0.01
CLIP_FAR = 100.0


def settings_from_camera(K: Any, R: Any, t: Any, width: int, height: int, bg: Optional[torch.Tensor] = None,
                         sh_degree: int = 3, scale_modifier: float = 1.0, dtype: Optional[torch.dtype] = None,
                         camera_model: str = "pinhole", distortion: Sequence[float] = (),
                         rolling_shutter: str = "global", end: Optional[Tuple[Any, Any]] = None,
                         **options: Any) -> GaussianRasterizationSettings:
    """The settings of a camera, transposed matrices included.

    Args:
        K: [3, 3] intrinsics in pixels: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]. As in COLMAP, the centre of the top left
            pixel is (0.5, 0.5); if it is (0, 0), as in OpenCV, add 0.5 to cx and cy. Of "orthographic" fx and fy are
            pixels by unit of length; of "equirectangular" None, as the image's size says all.
        R, t: [3, 3] and [3], world to view: x_view = R x_world + t, with x right, y down, z forward.
        width, height: of the image in pixels.
        bg: [C] background colour; black where it is None. The matrices are on its device.
        dtype: of the matrices, by default bg's, else float32.
        camera_model, distortion: the lens, and its numbers, as CAMERA_MODELS has them.
        rolling_shutter, end: one of ROLLING_SHUTTERS, and R and t at the last row or column; the others are those at
            the first. Colours are seen from the middle of both centres.
        options: further fields of the settings, such as blend_mode.
    K, R and t are tensors, arrays or lists. The matrices have gradients with respect to R, t and, in the projection, K.
    A lens has no gradient.

    Returns: GaussianRasterizationSettings. Raises ValueError if a shape does not fit, K has skew or focal lengths
    that are not positive, R is not a rotation, or a blend mode or a camera model is not known.
    """
    resolve_blend_mode(options.get("blend_mode"))  # refused if it is given, not at the first rendering
    dtype = dtype or (torch.float32 if bg is None else bg.dtype)
    bg = torch.zeros(3, dtype=dtype) if bg is None else bg
    if camera_model == "equirectangular":
        if K is not None:
            raise ValueError("settings_from_camera: K is given; an equirectangular camera has none, so it must be None")
        K = [[width / (2 * math.pi), 0, width / 2], [0, height / math.pi, height / 2], [0, 0, 1]]
    elif K is None:
        raise ValueError("settings_from_camera: K is None; only an equirectangular camera has none")
    elif camera_model != "pinhole" and getattr(K, "requires_grad", False):
        raise ValueError("settings_from_camera: K requires a gradient, but a lens has none; detach it")
    device = R.device if isinstance(R, torch.Tensor) else "cpu"  # computed there: elsewhere to check values would wait
    K = _float64("K", K, [3, 3], device)
    view, center = _pose("", R, t, device)
    rows = K.detach().tolist()
    fx, fy = rows[0][0], rows[1][1]
    if not (fx > 0 and fy > 0 and [rows[0][1], rows[1][0], *rows[2]] == [0, 0, 0, 0, 1]):
        raise ValueError(f"settings_from_camera: K is {rows}; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx "
                         "and fy above 0")
    ends = []
    if end is not None:
        if not (isinstance(end, (tuple, list)) and len(end) == 2):
            shape = f", shape {list(end.shape)}" if isinstance(end, torch.Tensor) else ""
            raise ValueError(f"settings_from_camera: end is of type {type(end).__name__}{shape}; it must be a tuple of "
                             "two, R [3, 3] and t [3] at the last row or column")
        view_end, center_end = _pose("end: ", *end, device)
        ends, center = [view_end.T], (center + center_end) / 2
    view, projection, center, *ends = (matrix.contiguous().to(bg.device, dtype) for matrix in (
        view.T, (clip_matrix(K, width, height) @ view).T, center, *ends))
    settings = GaussianRasterizationSettings(
        image_height=height, image_width=width, tanfovx=width / (2 * fx), tanfovy=height / (2 * fy), bg=bg,
        scale_modifier=scale_modifier, viewmatrix=view, projmatrix=projection, sh_degree=sh_degree, campos=center,
        camera_model=camera_model, distortion=tuple(numbers_of("distortion", distortion)),
        principal_point=None if camera_model == "pinhole" and end is None else (rows[0][2], rows[1][2]),
        rolling_shutter=rolling_shutter, viewmatrix_end=ends[0] if ends else None, **options)
    resolve_shutter(settings)
    resolve_lens(settings)
    return settings


def _float64(name, value, shape, device):
    value = torch.as_tensor(value, dtype=torch.float64, device=device)
    if list(value.shape) != shape:
        raise ValueError(f"settings_from_camera: {name} has shape {list(value.shape)}; it must be {shape}")
    return value


def _pose(of, R, t, device):
    """Returns the matrix from world to view [4, 4], for column vectors, and the camera's centre [3]."""
    R, t = _float64(of + "R", R, [3, 3], device), _float64(of + "t", t, [3], device)
    rotation = R.detach()
    error = (rotation @ rotation.T - torch.eye(3).to(rotation)).abs().max()
    if not (error < 1e-3 and torch.linalg.det(rotation) > 0):
        raise ValueError(f"settings_from_camera: {of}R is {rotation.tolist()}; it must be a rotation")
    last = R.new_tensor([[0.0, 0.0, 0.0, 1.0]])
    return torch.cat([torch.cat([R, t[:, None]], dim=1), last]), -R.T @ t


def clip_matrix(K: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """[..., 4, 4] view to clip coordinates, for column vectors, of pinhole intrinsics K [..., 3, 3] in pixels.

    Differentiable with respect to K, which is as in `settings_from_camera`.
    """
    # The rasterizer puts NDC x at pixel index ((x + 1) width - 1) / 2. COLMAP's coordinates are half a pixel above the
    # index: a point at fx X/Z + cx has x = 2 fx/width X/Z + 2 cx/width - 1; y likewise.
    image = torch.stack([2 * K[..., 0, :] / width, 2 * K[..., 1, :] / height], -2) - K.new_tensor([0.0, 0.0, 1.0])
    depth = CLIP_FAR / (CLIP_FAR - CLIP_NEAR)
    last = K.new_tensor([[0.0, 0.0, depth, -CLIP_NEAR * depth], [0.0, 0.0, 1.0, 0.0]])
    return torch.cat([torch.cat([image, torch.zeros_like(image[..., :1])], -1), last.expand(*K.shape[:-2], 2, 4)], -2)
