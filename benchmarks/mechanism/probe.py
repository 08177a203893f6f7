"""What a model in training is asked: how it looks, how opaque it is, who carries the picture, who lies near edges.

Nothing here changes the model, its gradients or a generator of random numbers.
"""
from __future__ import annotations

from typing import Dict, List, Optional, Sequence

import torch

from ...rasterizer import rasterize_with_splats
from ...trainer.results.metrics import psnr, quantised
from ...trainer.results.pictures import evenly_spaced
from ...trainer.results.rendering import Renderer
from ...trainer.scenes.scene import Scene
from ..suite.measure import edge_mask

VIEWS = 4  # evenly spaced test views, and as many training views
QUANTILES = (0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99)


class Probe:
    """Looks at a model through a few test and training views of its scene."""

    def __init__(self, renderer: Renderer, scene: Scene) -> None:
        """renderer: the training's own; scene: on its device."""
        self.model = renderer.model
        self.renderer = Renderer(renderer.model, renderer.blend_mode, renderer.background, renderer.antialiasing,
                                 rasterize_with_splats, background_gate=renderer.background_gate)
        self.test = [(scene.test[index].camera, scene.test[index].image_float())
                     for index in evenly_spaced(len(scene.test), VIEWS)]
        train = [scene.train[index] for index in evenly_spaced(len(scene.train), VIEWS)]
        self.train = [(view.camera, edge_mask(view.image_float())) for view in train]

    @torch.no_grad()
    def look(self) -> Dict[str, Optional[float]]:
        """psnr: of 8-bit images in dB. fullness: of a pixel, the sum of its blend weights: in alpha and smoe 1 - T.

        Means over the test views; None where there are none.
        """
        values: Dict[str, List[float]] = {"psnr": [], "fullness": []}
        for camera, target in self.test:
            rendering, _ = self.renderer(camera, outputs=("alpha",))
            values["psnr"].append(psnr(quantised(rendering.color), target))
            values["fullness"].append(float(rendering.alpha.mean()))
        return {name: sum(found) / len(found) if found else None for name, found in values.items()}

    def shares(self) -> torch.Tensor:
        """How much each of N Gaussians gives to the training views: [N], the factor of its colour, summed over pixels.

        The factor is the weight in the blend's numerator, in SMoE modes over its denominator. One rendering and its
        backward pass for each view.
        """
        found = self.model.raw["means3D"].detach().new_zeros(self.model.num_gaussians)
        for camera, _ in self.train:
            # A pixel is linear in the colours: the gradient of the sum of all pixels by a colour is its share.
            leaf = found.new_zeros(len(found), 3).requires_grad_()
            with torch.enable_grad():
                rendering, _ = self.renderer(camera, colors_precomp=leaf)
                share, = torch.autograd.grad(rendering.color[0].sum(), leaf)
            found = found + share[:, 0]
        return found

    @torch.no_grad()
    def edges(self, chosen: torch.Tensor) -> Dict[str, Optional[float]]:
        """Fractions near the strong edges of the training views (protocol.EDGE_RULE).

        area: of the pixels. all: of the Gaussians whose centres lie inside an image, counted once a view. chosen: of
        those among them where the mask [N] (bool) is True; None where none is seen.
        """
        counts = torch.zeros(2, 2, dtype=torch.long, device=chosen.device)  # all, chosen; near edges, seen
        near_pixels = pixels = 0
        nothing = self.model.raw["means3D"].detach().new_zeros(len(chosen), 3)
        for camera, mask in self.train:
            rendering, splats = self.renderer(camera, colors_precomp=nothing)
            column, row = splats.centers.round().long().unbind(1)
            inside = ((rendering.radii > 0) & (column >= 0) & (column < camera.width)
                      & (row >= 0) & (row < camera.height))
            near = inside & mask[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
            counts += torch.stack([torch.stack([near.sum(), inside.sum()]),
                                   torch.stack([(near & chosen).sum(), (inside & chosen).sum()])])
            near_pixels, pixels = near_pixels + int(mask.sum()), pixels + mask.numel()
        fractions = [near / seen if seen else None for near, seen in counts.tolist()]
        return {"area": near_pixels / pixels, "all": fractions[0], "chosen": fractions[1]}


def quantiles(values: torch.Tensor, levels: Sequence[float] = QUANTILES) -> Optional[List[float]]:
    """The quantiles of values [N] at levels; None where there are no values."""
    if not len(values):
        return None
    ordered = values.detach().sort().values  # torch.quantile takes no more than 16 million
    return [float(ordered[round(level * (len(ordered) - 1))]) for level in levels]


def median(values: torch.Tensor) -> Optional[float]:
    """The median of values [N]; None where there are no values."""
    found = quantiles(values, (0.5,))
    return found[0] if found else None
