"""Photographs through lenses as a pinhole camera would have taken them: a training through a lens shows some of these.

The footprint of a Gaussian far beside the image is a coarse approximation, and through a lens another one than through
a pinhole. What no training view showed would lie as haze over the pinhole images of viewers.
"""
from __future__ import annotations

import dataclasses
import functools
from typing import Callable, Dict, List, Sequence, Tuple

import numpy as np
import torch

from .cameras import Camera
from .images import View

EVERY = 8  # of so many views through lenses, one is shown by a pinhole; even
KEPT_BYTES = 2**30  # of pinhole images, at most
VIEW_BYTES, MAP_BYTES = 5, 9  # for each pixel: colours, opacity and mask; a place on the bent image, and whether it is

Map = Tuple[torch.Tensor, torch.Tensor]


def pinhole_every(views: Sequence[View], iterations: int) -> int:
    """Of how many views of a training on these one is shown by a pinhole; 0: none is.

    The last step of a training changes nothing, so a training of one step shows none.
    """
    return EVERY if iterations > 1 and any(_is_bent(view.camera) for view in views) else 0


def _is_bent(camera: Camera) -> bool:
    """But for panoramas: what a pinhole sees of them is a few columns, magnified."""
    return camera.lens is not None and not camera.is_panorama


def _places(bent: Camera, straight: Camera, device: str) -> Map:
    """Where the pixels of a pinhole camera lie on the bent image, [1, H, W, 2] as `grid_sample` takes it.

    And [1, H, W] uint8: 255 where the image shows them, else 0. The cameras have the same pose, which does not matter.
    The rasterizer says it of a point on each pixel's ray.
    """
    from diff_smoe_rasterization import project_gaussians  # late: a scene needs no extension

    x = (torch.arange(straight.width, device=device) + 0.5 - straight.cx) / straight.fx
    y = (torch.arange(straight.height, device=device) + 0.5 - straight.cy) / straight.fy
    y, x = (axis.flatten() for axis in torch.meshgrid(y, x, indexing="ij"))
    points = torch.stack([x, y, torch.ones_like(x)], dim=1)
    camera = dataclasses.replace(bent, rotation=np.eye(3), translation=np.zeros(3))
    settings = camera.settings(torch.zeros(3, device=device), 0, "alpha")
    prints = project_gaussians(points, points[:, 2], settings, colors_precomp=points,
                               scales=torch.full_like(points, 1e-6),
                               rotations=torch.eye(4, device=device)[:1].expand(len(points), -1))
    size = torch.tensor([bent.width, bent.height], device=device)
    places = (2 * prints.means2D + 1) / size - 1  # -1 and 1 are the outer edges of the image's pixels
    shown = (prints.radii > 0) & (places.abs() <= 1).all(1)
    shape = (1, straight.height, straight.width)
    return places.masked_fill(~shown[:, None], -1).view(*shape, 2), (255 * shown).to(torch.uint8).view(shape)


def straightened(view: View, camera: Camera, places: Callable[[Camera, Camera, str], Map] = _places) -> View:
    """A view through a lens by a pinhole camera in its place. What the photograph does not show is masked."""
    grid, shown = places(dataclasses.replace(view.camera, name="", rotation=None, translation=None),
                         dataclasses.replace(camera, name="", rotation=None, translation=None), str(view.image.device))

    def seen(planes: torch.Tensor, mode: str) -> torch.Tensor:
        values = torch.nn.functional.grid_sample(planes[None].float(), grid, mode, "border", align_corners=False)
        return values[0].round().clamp(0, 255).to(torch.uint8)

    mask = shown if view.mask is None else torch.minimum(seen(view.mask, "bilinear"), shown)
    return dataclasses.replace(view, camera=camera, image=seen(view.image, "bicubic"), mask=mask,
                               opacity=None if view.opacity is None else seen(view.opacity, "bicubic"))


class StraightViews:
    """The pinhole images of views through lenses, each made when it is first shown.

    The first ones stay in memory, as many as KEPT_BYTES hold; others are made anew each time.
    """

    def __init__(self, views: Sequence[View]) -> None:
        bent = [view.camera for view in views if _is_bent(view.camera)]
        self._cameras = {camera.name: dataclasses.replace(camera.pinhole(), name=f"{camera.name} (pinhole)")
                         for camera in bent}
        self._pixels = max((camera.width * camera.height for camera in self.cameras), default=0)
        self._most = min(len(self._cameras), KEPT_BYTES // max(1, VIEW_BYTES * self._pixels))
        self._kept: Dict[str, View] = {}
        self._places = functools.lru_cache(maxsize=1)(_places)  # most scenes have one lens

    @property
    def cameras(self) -> List[Camera]:
        """All that `of` may give."""
        return [*self._cameras.values()]

    @property
    def most_bytes(self) -> int:
        """At most so many bytes stay in use: for the kept images, and for where the pixels of one lie."""
        return (self._most * VIEW_BYTES + MAP_BYTES) * self._pixels

    def of(self, view: View, iteration: int) -> View:
        """What the training shows in this iteration: the view, or in 1, 1 + EVERY and so on its pinhole image.

        EVERY is even, so these iterations are odd. The loss curve takes every 10th or 100th iteration, and so shows
        only photographs, but for its end; of a batch it takes the mean.
        """
        name = view.camera.name
        if iteration % EVERY != 1 or name not in self._cameras:
            return view
        if name in self._kept:
            return self._kept[name]
        made = straightened(view, self._cameras[name], self._places)
        if len(self._kept) < self._most:
            self._kept[name] = made
        return made
