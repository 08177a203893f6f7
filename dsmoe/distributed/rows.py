"""The footprints of some Gaussians in several views, row behind row, and the gradients back. The ops are the core's."""
from __future__ import annotations

from typing import Any, Dict, Iterator, List, Optional, Sequence, Tuple

import torch

from diff_smoe_rasterization.autograd import INPUTS
from diff_smoe_rasterization.core import _core
from diff_smoe_rasterization.footprints import GATE_NUMBERS, camera_tensors, image_numbers, projection_arguments
from diff_smoe_rasterization.settings import GaussianRasterizationSettings

_OPS = torch.ops.diff_smoe_rasterization
FEATURE_NUMBERS = 4  # of a row: the colour, and the bits of the radius


class ViewRows:
    """Rows of all views in the order of the Gaussians. Call `project` once, then `backward`."""

    def __init__(self, settings: Sequence[GaussianRasterizationSettings], means3D: torch.Tensor,
                 opacities: torch.Tensor, **tensors: torch.Tensor) -> None:
        """Counts the rows. tensors: dc, shs, scales and rotations, as `rasterize` takes them. All are float32."""
        self._arguments = []
        most = _core.constants["most_views"]
        for begin in range(0, len(settings), most):
            some = settings[begin:begin + most]
            inputs, options = projection_arguments(some[0], means3D, opacities, **tensors)
            cameras = [tensor for each in some for tensor in camera_tensors(each)]
            images = [number for each in some for number in image_numbers(each)]
            self._arguments.append((*inputs, *options, True, cameras, images))
        self._present = [tensor is not None for tensor in inputs]
        counted = [_OPS.count_rows(*arguments) for arguments in self._arguments]
        self._offsets = [offsets for _, offsets in counted]
        self._radii = [radii for radii, _ in counted]
        self.counts = torch.cat([offsets[:, -1] for offsets in self._offsets]).long()  # [V] rows of each view

    @property
    def radii(self) -> List[torch.Tensor]:
        """Of each view [N] int32; above 0 if it sees the Gaussian, not 0 if the Gaussian has a row."""
        return [radii for some in self._radii for radii in some]

    def project(self, counts: Sequence[int], order: Sequence[int]) -> Tuple[torch.Tensor, torch.Tensor]:
        """The rows: gates [M, 8] and features [M, 4], in this order of the views. counts: the numbers in `counts`."""
        like = self._arguments[0][INPUTS.index("means3D")]
        total = sum(counts)
        gates = like.new_empty((total, GATE_NUMBERS))
        features = like.new_empty((total, FEATURE_NUMBERS))
        lengths = [counts[view] for view in order]
        gates_of, self._features = (
            [part for _, part in sorted(zip(order, tensor.split(lengths)), key=lambda pair: pair[0])]
            for tensor in (gates, features))
        for arguments, radii, offsets, views in self._parts():
            _OPS.project_rows(*arguments, radii, offsets, gates_of[views], self._features[views])
        return gates, features

    def backward(self, records: List[torch.Tensor]) -> Tuple[Dict[str, torch.Tensor], List[torch.Tensor]]:
        """From gradients by the rows of each view, [M, 9], to those by the arguments.

        Returns their sums over the views in order, by the arguments' names. And of each view dL/dpixel times (W / 2,
        H / 2), [N, 3], written where the radius is above 0.
        """
        sums: Optional[List[torch.Tensor]] = None
        means2D: List[torch.Tensor] = []
        for arguments, radii, offsets, views in self._parts():
            of_views, gradients = _OPS.project_rows_backward(*arguments, radii, offsets, self._features[views],
                                                             records[views])
            means2D += of_views
            if sums is None:
                sums = gradients
            else:
                torch._foreach_add_(sums, gradients)
        names = [name for name, here in zip(INPUTS, self._present)
                 if here and name in ("means3D", "opacities", "dc", "shs", "scales", "rotations")]
        assert sums is not None
        return dict(zip(names, sums)), means2D

    def _parts(self) -> Iterator[Tuple[Tuple[Any, ...], torch.Tensor, torch.Tensor, slice]]:
        """The arguments of the ops for as many views as they take at once, and which these are."""
        begin = 0
        for arguments, radii, offsets in zip(self._arguments, self._radii, self._offsets):
            yield arguments, radii, offsets, slice(begin, begin + len(radii))
            begin += len(radii)
