"""A batch of views of Gaussians that are divided over processes: footprints go to where a view is blended.

Every process projects its own Gaussians for all views and sends what a view sees to the process that blends it. The
gradients by those footprints come back, and each process makes of them the gradients of its own Gaussians. A process
by itself does the same without sending.
"""
from __future__ import annotations

from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

import torch

from diff_smoe_rasterization.autograd import INPUTS
from diff_smoe_rasterization.footprints import GATE_GRADIENTS, Footprints, blend_op_arguments, projection_arguments
from diff_smoe_rasterization.settings import GaussianRasterizationSettings
from diff_smoe_rasterization.splats import Splats

from ..model import GaussianModel
from ..system.group import Group
from ..training.strategy import Look

_OPS = torch.ops.diff_smoe_rasterization
_GATE = 8  # numbers of a footprint before its features
PER_GAUSSIAN = [name for name in INPUTS if name in ("means3D", "means2D", "opacities", "dc", "shs", "scales",
                                                    "rotations")]


class Projected(NamedTuple):
    """The own Gaussians on the image of one view, as the backward pass needs them."""

    inputs: Sequence[Optional[torch.Tensor]]  # of the op `project`
    options: Sequence[Any]  # likewise
    visible: torch.Tensor  # [M] int64
    features: torch.Tensor  # [M, F]
    radii: torch.Tensor  # [N] int32


class DrawnImage:
    """One view as this process has blended it."""

    def __init__(self, footprints: Footprints, settings: GaussianRasterizationSettings, for_backward: bool) -> None:
        self.radii = footprints.radii
        self._tensors, self._options = blend_op_arguments(footprints, settings)
        self._options = (*self._options, for_backward)
        *images, self._saved = _OPS.blend(*self._tensors, *self._options)
        self._images = images
        self.color: torch.Tensor = images[0]  # [C, H, W]

    def splats(self) -> Splats:
        """What the pixels say of each footprint."""
        color, gate_sum, *_ = self._images
        inputs = dict(zip(("radii", "bg", "background_gate"), self._tensors[2:]))
        return Splats([color, self.radii, gate_sum], self._saved, [inputs.get(name) for name in INPUTS],
                      self._options[:-1])

    def backward(self, dL_dcolor: torch.Tensor, wants_gate: bool) -> Tuple[torch.Tensor, torch.Tensor]:
        """Gradients by the footprints, [M, 6 + F], and by the background's gate, [1], or [0] where it is not wanted."""
        radii, bg, gate = self._tensors[2:]
        records, _, dL_dgate = _OPS.blend_backward(dL_dcolor, None, None, None, self._images, self._saved, radii, bg,
                                                   gate, *self._options, wants_gate)
        return records, dL_dgate


class Batch:
    """The views of one step, from projection to gradients. View k is blended by process k of the group, in turns."""

    def __init__(self, group: Group, gaussians: Dict[str, torch.Tensor],
                 settings: Sequence[GaussianRasterizationSettings], note: int = 0) -> None:
        """Projects and sends. gaussians: the arguments of a rendering that have a row for each own one.

        settings: of each view. note: a number; `notes` has those of all processes.
        """
        self.group = group
        self.owners = [view % group.size for view in range(len(settings))]
        self.own_views = [view for view, owner in enumerate(self.owners) if owner == group.rank]
        # Order of the views in the send buffer: grouped by receiver.
        self._order = sorted(range(len(settings)), key=lambda view: self.owners[view])
        self.projected: List[Projected] = []
        packed: List[torch.Tensor] = []
        for each in settings:
            inputs, options = projection_arguments(settings=each, means2D=gaussians["means3D"], **gaussians)
            gates, features, radii = _OPS.project(*inputs, *options, True)
            visible = radii.nonzero().squeeze(1)
            packed.append(_OPS.pack_footprints(gates, features, radii, visible))
            features = features.index_select(0, visible)
            self.projected.append(Projected(inputs, (*options, True), visible, features, radii))
        *rows, notes = zip(*group.gather_numbers([*map(len, packed), note], str(radii.device)))
        self.notes = list(notes)
        self._counts: List[Sequence[int]] = rows  # [view][process] how many footprints
        if group.size == 1:
            self._arrived = {view: [rows] for view, rows in enumerate(packed)}
        else:
            outgoing = joined([packed[view] for view in self._order])
            self._arrived = self._split(group.exchange(outgoing, *self._lengths(self._order)))

    def _lengths(self, views: Sequence[int]) -> Tuple[List[int], List[int]]:
        """How many rows of footprints of these views go to each process, and how many come from each."""
        group = self.group
        sent = [sum(self._counts[view][group.rank] for view in views if self.owners[view] == rank)
                for rank in range(group.size)]
        received = [sum(self._counts[view][rank] for view in views if view in self.own_views)
                    for rank in range(group.size)]
        return sent, received

    def _split(self, rows: torch.Tensor) -> Dict[int, List[torch.Tensor]]:
        """What came, by own view the rows of each process in their order: that of all Gaussians."""
        parts = iter(rows.split([self._counts[view][rank] for rank in range(self.group.size)
                                 for view in self.own_views]))
        by_rank = [{view: next(parts) for view in self.own_views} for _ in range(self.group.size)]
        return {view: [of_rank[view] for of_rank in by_rank] for view in self.own_views}

    @property
    def radii(self) -> torch.Tensor:
        """[N] int32 above 0 where a view shows the own Gaussian."""
        return torch.stack([projected.radii for projected in self.projected]).amax(0)

    def draw(self, view: int, settings: GaussianRasterizationSettings, for_backward: bool = True) -> DrawnImage:
        """Blends one of the own views, once."""
        rows = joined(self._arrived.pop(view))
        radii = rows[:, -1].contiguous().view(torch.int32)
        return DrawnImage(Footprints(rows[:, :_GATE], rows[:, _GATE:-1], radii), settings, for_backward)

    def give_back(self, records: Dict[int, torch.Tensor]) -> List[torch.Tensor]:
        """From the gradients by the footprints of each own view to those by the own footprints of each view.

        The records are taken out of `records`.
        """
        width = GATE_GRADIENTS + self.projected[0].features.shape[1]
        return self._return(records, range(len(self.owners)), width)

    def looks(self, own: Dict[int, Look], views: Sequence[int]) -> List[Look]:
        """From looks at own views, at their footprints, to looks at these views, at the own Gaussians."""
        rows = {view: torch.stack(look, 1) for view, look in own.items()}
        looks: List[Look] = []
        for view, part in zip(views, self._return(rows, views, len(Look._fields))):
            projected = self.projected[view]
            dense = part.new_zeros((len(projected.radii), part.shape[1]))
            dense.index_copy_(0, projected.visible, part)
            looks.append(Look(*dense.unbind(1)))
        return looks

    def _return(self, rows: Dict[int, torch.Tensor], views: Sequence[int], width: int) -> List[torch.Tensor]:
        """From rows [M, width] for the footprints of each own view to rows for the own footprints of these views.

        views: the same in all processes, rising. The rows are taken out of `rows`.
        """
        if self.group.size == 1:
            return [rows.pop(view) for view in views]
        own = [view for view in self.own_views if view in views]
        by_view = {view: rows.pop(view).split(list(self._counts[view])) for view in own}
        parts = [by_view[view][rank] for rank in range(self.group.size) for view in own]
        order = [view for view in self._order if view in views]
        sent, received = self._lengths(order)
        outgoing = joined(parts) if parts else self.projected[0].features.new_empty((0, width))
        del by_view, parts
        returned = self.group.exchange(outgoing, received, sent)
        pieces = returned.split([self._counts[view][self.group.rank] for view in order])
        return [piece for _, piece in sorted(zip(order, pieces), key=lambda pair: pair[0])]

    def backward(self, records: List[torch.Tensor], gradients: Dict[str, torch.Tensor]) -> List[torch.Tensor]:
        """Writes gradients by the Gaussians, sums over the views in their order.

        records: what `give_back` returned; it is emptied. gradients: by argument, of its shape; rows that no view shows
        stay as they are. Returns for each view dL/dpixel times (W / 2, H / 2), [N, 3], in rows that it shows.
        """
        seen = self.radii.nonzero().squeeze(1)
        for gradient in gradients.values():
            gradient.index_fill_(0, seen, 0)
        means2D: List[torch.Tensor] = []
        for projected in self.projected:
            by_name = self._by_visible(projected, records.pop(0))
            dense = gradients["means3D"].new_empty((len(projected.radii), 3))
            means2D.append(dense.index_copy_(0, projected.visible, by_name.pop("means2D")))
            for name, gradient in by_name.items():
                gradients[name].flatten(1).index_add_(0, projected.visible, gradient.flatten(1))
        return means2D

    @staticmethod
    def _by_visible(projected: Projected, records: torch.Tensor) -> Dict[str, torch.Tensor]:
        """The gradients by the rows that one view shows, from those by their footprints."""
        inputs = dict(zip(INPUTS, projected.inputs))
        names = [name for name in PER_GAUSSIAN if inputs[name] is not None]
        # Only these rows are read and written, which are few of all.
        inputs.update(zip(names, _OPS.gather_rows([inputs[name] for name in names], projected.visible)))
        present = [tensor is not None for tensor in inputs.values()]
        radii = projected.radii.index_select(0, projected.visible)
        gradients = _OPS.project_backward(
            records, None, [tensor for tensor in inputs.values() if tensor is not None], present, projected.features,
            radii, *projected.options, [name in names for name in INPUTS])
        return dict(zip(names, gradients))


def gaussians_of(model: GaussianModel) -> Dict[str, torch.Tensor]:
    """A model's Gaussians as `Batch` takes them."""
    opacities, scales, rotations = model.activated()
    return {"means3D": model.raw["means3D"], "opacities": opacities, "scales": scales, "rotations": rotations,
            **model.color_arguments()}


def joined(parts: Sequence[torch.Tensor]) -> torch.Tensor:
    """All rows of the parts, copied only where there are several parts."""
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))
