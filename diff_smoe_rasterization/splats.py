"""What one rendering knows of each Gaussian: its place on the image, and what its pixels say of it."""
from __future__ import annotations

from typing import Any, Optional, Sequence

import torch

from .extension import _C  # noqa: F401  (loading it registers the ops)
from .settings import Contributions

_OPS = torch.ops.diff_smoe_rasterization


class Splats:
    """N Gaussians on the image plane of one rendering, and its lists of those that each tile shows.

    Nothing here has a gradient. What a culled Gaussian (radius 0) has is 0 everywhere.
    """

    def __init__(self, radii: torch.Tensor, saved: Sequence[torch.Tensor], background_gate: Optional[torch.Tensor],
                 options: Sequence[Any]):
        """saved: what the op `rasterize` saved. background_gate, options: what it was given, for_backward left out."""
        self._radii = radii
        self._saved = [tensor.detach() for tensor in saved]
        self._projected = self._saved[0]
        # A tensor is copied: an optimizer may change it before anybody asks for contributions.
        self._background_gate = None if background_gate is None else background_gate.detach().clone()
        self._options = (*options, False)

    @property
    def centers(self) -> torch.Tensor:
        """[N, 2] where the centres fall, x and y in pixels; the centre of the first pixel is (0, 0)."""
        return self._of_visible(self._projected[:, :2])

    @property
    def depths(self) -> torch.Tensor:
        """[N] distances from the camera along its axis, the view z."""
        return self._of_visible(self._projected[:, 7])

    def contributions(self, pixel_weights: torch.Tensor) -> Contributions:
        """Sums a map over the pixels of each Gaussian, and what else `Contributions` names.

        pixel_weights: [H, W], any numbers, of the Gaussians' type and device. On the CPU the sums are equal bit for bit
        from call to call and for any number of threads; on CUDA real numbers are added by atomics in any order, and
        the host does not wait.
        Raises ValueError or TypeError where pixel_weights does not fit.
        """
        if not isinstance(pixel_weights, torch.Tensor):
            raise TypeError(f"contributions: pixel_weights is of type {type(pixel_weights).__name__}; it must be a "
                            "torch.Tensor")
        return Contributions(*_OPS.contributions(pixel_weights.detach(), self._radii, self._saved,
                                                 self._background_gate, *self._options))

    def _of_visible(self, values: torch.Tensor) -> torch.Tensor:
        """Returns a copy with zeros for culled Gaussians, whose rows may hold anything."""
        culled = self._radii <= 0
        return values.masked_fill(culled if values.dim() == 1 else culled[:, None], 0)
