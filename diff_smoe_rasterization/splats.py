"""What one rendering knows of each Gaussian: its place on the image, and what its pixels say of it."""
from __future__ import annotations

from typing import Any, Optional, Sequence

import torch

from .autograd import INPUTS, refuse_transforms, register_fake  # which also registers the ops
from .checks import check_tensors
from .settings import Contributions, GateMap, Importance

_OPS = torch.ops.diff_smoe_rasterization


class Splats:
    """N Gaussians on the image plane of one rendering, and the list of Gaussians of each tile.

    Nothing here has a gradient. Every value of a culled Gaussian (radius 0) is 0.
    """

    def __init__(self, images: Sequence[torch.Tensor], saved: Sequence[torch.Tensor],
                 inputs: Sequence[Optional[torch.Tensor]], options: Sequence[Any]):
        """images, saved: what the op `rasterize` returned. inputs, options: what it was given, without for_backward."""
        background, background_gate = (inputs[INPUTS.index(name)] for name in ("bg", "background_gate"))
        assert background is not None
        self._color, self._radii, self._gate_sum = (image.detach() for image in images[:3])
        self._saved = [tensor.detach() for tensor in saved]
        self._projected = self._saved[0]
        # Copies: an optimizer may change these before anybody asks for sums.
        self._background = background.detach().clone()
        self._background_gate = None if background_gate is None else background_gate.detach().clone()
        self._options = (*options, False)

    @property
    def centers(self) -> torch.Tensor:
        """[N, 2] the centres on the image, x and y in pixels; the centre of the first pixel is (0, 0)."""
        return self._of_visible(self._projected[:, :2])

    @property
    def depths(self) -> torch.Tensor:
        """[N] view z, or what `CAMERA_MODELS` has as the depth."""
        return self._of_visible(self._projected[:, 7])

    def contributions(self, pixel_weights: torch.Tensor) -> Contributions:
        """Sums a map over the pixels of each Gaussian, and what else `Contributions` names.

        pixel_weights: [H, W], any numbers, of the Gaussians' type and device. On the CPU the sums are equal bit for bit
        from call to call and for any number of threads. On CUDA real numbers are added by atomics in any order, unless
        the settings had `deterministic`, and the host does not wait.
        Raises ValueError or TypeError if pixel_weights does not fit.
        """
        check_tensors("contributions", pixel_weights=pixel_weights)
        refuse_transforms("contributions", [pixel_weights])
        return Contributions(*_OPS.contributions(pixel_weights.detach(), self._radii, self._saved,
                                                 self._background_gate, *self._options))

    def importance(self, pixel_weights: Optional[torch.Tensor] = None,
                   share_weights: Optional[torch.Tensor] = None) -> Importance:
        """What each Gaussian is worth to the image: its share of the pixels, and what its removal would change.

        pixel_weights: [H, W] e, any numbers, such as a mask; None: 1. share_weights: [H, W] e of the shares, if it
        is another one, such as the error of each pixel; None: pixel_weights.
        Both are of the Gaussians' type and device. The colour image, and the alpha image if it was asked for, must
        be as they were rendered: an image that was edited in place since gives other numbers.

        The cost is the change to a rendering without the Gaussian, with two exceptions. Which pairs of a pixel count by
        `faint_below`, and in `smoe` the sum of its tails, stay as they are. Gaussians behind a full pixel (T < 1e-4)
        are ignored; without one in front their weight could be up to T / (1 - alpha). A pixel with nothing else shows
        the background's colour.

        Sums are as exact and reproducible as in `contributions`. Raises ValueError or TypeError if a map does not
        fit.
        """
        if pixel_weights is None:
            pixel_weights = torch.ones_like(self._gate_sum[0])
        if share_weights is None:
            share_weights = pixel_weights
        check_tensors("importance", pixel_weights=pixel_weights, share_weights=share_weights)
        refuse_transforms("importance", [pixel_weights, share_weights])
        return Importance(*_OPS.importance(pixel_weights.detach(), share_weights.detach(), self._color, self._gate_sum,
                                           self._background, self._radii, self._saved, self._background_gate,
                                           *self._options))

    def gate_map(self) -> GateMap:
        """Finds each pixel's Gaussian of the largest gate, and the median one; the background is not a candidate.

        The alpha image, if it was asked for, must be as it was rendered. The same bits from call to call. On CUDA the
        host does not wait.
        """
        return GateMap(*_OPS.gate_map(self._gate_sum, self._radii, self._saved, self._background_gate, *self._options))

    def _of_visible(self, values: torch.Tensor) -> torch.Tensor:
        """Returns a copy with zeros for culled Gaussians, whose rows may hold anything."""
        culled = self._radii <= 0
        return values.masked_fill(culled if values.dim() == 1 else culled[:, None], 0)


def _fake_contributions(pixel_weights, radii, *others):
    def sums():
        return pixel_weights.new_empty(radii.shape)

    return sums(), torch.empty_like(radii), sums(), sums()


register_fake("contributions", _fake_contributions)
register_fake("importance", lambda pixel_weights, share_weights, color, gate_sum, bg, radii, *others: tuple(
    pixel_weights.new_empty(radii.shape) for _ in range(3)))
register_fake("gate_map", lambda gate_sum, radii, *others: tuple(
    radii.new_empty(gate_sum.shape[1:]) for _ in range(3)))
