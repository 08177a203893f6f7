"""A batch of views of Gaussians that are divided over processes: footprints go to where a view is blended.

Every process projects its own Gaussians for all views and sends what a view sees to the process that blends it. The
gradients of those footprints come back, and each process computes the gradients of its own Gaussians from them. A
single process does the same without sending.
"""
from __future__ import annotations

from typing import Callable, Dict, List, Optional, Sequence, Tuple

import torch

from diff_smoe_rasterization.autograd import INPUTS
from diff_smoe_rasterization.footprints import GATE_GRADIENTS, Footprints, blend_op_arguments
from diff_smoe_rasterization.settings import GaussianRasterizationSettings
from diff_smoe_rasterization.splats import Splats

from ..model import PARAMETERS, GaussianModel
from ..scenes.images import View
from ..system.group import Group
from ..training.strategy import Look, look_at
from .rows import ViewRows

_OPS = torch.ops.diff_smoe_rasterization
_RECORD = GATE_GRADIENTS + 3  # numbers: gradients by a row


class DrawnImage:
    """One view as this process has blended it, a panorama without a seam."""

    def __init__(self, footprints: Footprints, settings: GaussianRasterizationSettings, for_backward: bool) -> None:
        self._copied: Sequence[torch.Tensor] = ()
        if settings.camera_model == "equirectangular":
            self._copied = footprints.copied(settings.image_width)
            footprints = footprints.around(settings.image_width)
        self.radii = footprints.radii
        self._tensors, self._options = blend_op_arguments(footprints, settings)
        self._options = (*self._options, for_backward)
        *images, self._saved = _OPS.blend(*self._tensors, *self._options)
        self._images = images
        self.color: torch.Tensor = images[0]  # [C, H, W]

    def look(self, view: View, target: torch.Tensor) -> Look:
        """At the footprints. target: what the view's image is compared with."""
        color, gate_sum, *_ = self._images
        inputs = dict(zip(("radii", "bg", "background_gate"), self._tensors[2:]))
        splats = Splats([color, self.radii, gate_sum], self._saved, [inputs.get(name) for name in INPUTS],
                        self._options[:-1])
        return Look(*map(self._with_copies, look_at(view, target, color, splats)))

    def backward(self, dL_dcolor: torch.Tensor, wants_gate: bool) -> Tuple[torch.Tensor, torch.Tensor]:
        """Gradients by the footprints, [M, 6 + F], and by the background's gate, [1], or [0] if it is not wanted."""
        radii, bg, gate = self._tensors[2:]
        records, _, dL_dgate = _OPS.blend_backward(dL_dcolor, None, None, None, self._images, self._saved, radii, bg,
                                                   gate, *self._options, wants_gate)
        return self._with_copies(records), dL_dgate

    def _with_copies(self, rows: torch.Tensor) -> torch.Tensor:
        """Rows of the footprints, with those of their copies added; rows: of these too, [M + copies, ...]."""
        lengths = [len(index) for index in self._copied]
        own, *copies = rows.split([len(rows) - sum(lengths), *lengths])
        for index, part in zip(self._copied, copies):
            own[index] += part  # no index is there twice
        return own


class Batch:
    """The views of one step, from projection to gradients.

    They are blended in rounds; in each a process has at most one view. Meanwhile the rows of the next rounds and the
    gradients of earlier ones are sent. Each process holds a consecutive part of all Gaussians, so that the rows of a
    view, process by process, keep the Gaussians' order.
    """

    def __init__(self, group: Group, model: GaussianModel, settings: Sequence[GaussianRasterizationSettings],
                 note: int = 0) -> None:
        """Projects, and begins to send. settings: of each view. note: a number; `notes` has those of all processes."""
        self.group, self.model, self.settings = group, model, settings
        self._values = model.activated()
        opacities, scales, rotations = self._values
        self._rows = ViewRows(settings, model.raw["means3D"], opacities, scales=scales, rotations=rotations,
                              **model.color_arguments())
        self.radii = self._rows.radii
        own = self._rows.counts
        gathered = group.gather_numbers(torch.cat([own, own.new_full((1,), note)]), str(own.device))
        *counts, notes = zip(*gathered)
        self.notes = list(notes)
        self._counts: List[Sequence[int]] = counts  # [view][process] how many rows
        self.rounds = rounds_of([sum(of_view) for of_view in counts], group.size)
        order = [view for views in self.rounds for _, view in sorted(views.items())]
        tensors = self._rows.project([of_view[group.rank] for of_view in counts], order)
        lengths = [sum(self._sent(views)) for views in self.rounds]
        self._arriving = [[group.begin_exchange(part, self._sent(views), self._received(views)) for part in parts]
                          for views, *parts in zip(self.rounds, *(tensor.split(lengths) for tensor in tensors))]
        self._returning: Dict[int, Callable[[], torch.Tensor]] = {}  # by round

    def _sent(self, views: Dict[int, int]) -> List[int]:
        """How many own rows of a round go to each process."""
        return [self._counts[views[rank]][self.group.rank] if rank in views else 0 for rank in range(self.group.size)]

    def _received(self, views: Dict[int, int]) -> List[int]:
        """How many rows come from each process for the own view of a round."""
        rank = self.group.rank
        return list(self._counts[views[rank]]) if rank in views else [0] * self.group.size

    def draw(self, index: int, for_backward: bool = True) -> Optional[Tuple[int, DrawnImage]]:
        """Blends the own view of a round. Call it once for each round, in their order. Returns None without a view."""
        gates, features = (end() for end in self._arriving[index])
        self._arriving[index] = []
        view = self.rounds[index].get(self.group.rank)
        if view is None:
            return None
        radii = features.view(torch.int32)[:, -1].contiguous()
        return view, DrawnImage(Footprints(gates, features, radii), self.settings[view], for_backward)

    def send_back(self, index: int, records: Optional[torch.Tensor]) -> None:
        """Begins to return gradients by the rows of the own view of a round; None without a view."""
        self._returning[index] = self._begin_return(self.rounds[index], records, _RECORD)

    def _begin_return(self, views: Dict[int, int], rows: Optional[torch.Tensor], width: int
                      ) -> Callable[[], torch.Tensor]:
        if rows is None:
            rows = self._values[0].new_empty((0, width))
        return self.group.begin_exchange(rows, self._received(views), self._sent(views))

    def _by_view(self, views: Dict[int, int], rows: torch.Tensor) -> Dict[int, torch.Tensor]:
        """What has returned of a round, for the own rows of each view."""
        parts = rows.split(self._sent(views))
        return {view: parts[rank] for rank, view in views.items()}

    def looks(self, own: Dict[int, Look], wanted: Sequence[int]) -> List[Look]:
        """From looks at own views, at their footprints, to looks at the wanted views, at the own Gaussians."""
        found: Dict[int, Look] = {}
        for views in self.rounds:
            some = {rank: view for rank, view in views.items() if view in wanted}
            if not some:
                continue
            look = own.get(some[self.group.rank]) if self.group.rank in some else None
            rows = None if look is None else torch.stack(look, 1)
            returned = self._begin_return(some, rows, len(Look._fields))()
            for view, part in self._by_view(some, returned).items():
                radii = self.radii[view]
                dense = part.new_zeros((len(radii), part.shape[1]))
                dense.index_copy_(0, radii.nonzero().squeeze(1), part)
                found[view] = Look(*dense.unbind(1))
        return [found[view] for view in wanted]

    def backward(self) -> List[torch.Tensor]:
        """Sets the gradients of the model's parameters, sums over the views in their order.

        Returns for each view dL/dpixel times (W / 2, H / 2), [N, 3], written where the radius is above 0.
        """
        records: Dict[int, torch.Tensor] = {}
        for index, views in enumerate(self.rounds):
            records.update(self._by_view(views, self._returning.pop(index)()))
        gradients, means2D = self._rows.backward([records[view] for view in range(len(records))])
        self._set_gradients(gradients)
        return means2D

    def _set_gradients(self, by_input: Dict[str, torch.Tensor]) -> None:
        raw = self.model.raw
        through = ("opacities", "scales", "rotations")
        gradients = _OPS.activate_backward([raw[name] for name in through], list(self._values),
                                           *(by_input[name] for name in through))
        by_name = {"means3D": by_input["means3D"], **dict(zip(through, gradients))}
        if self.model.active_sh_degree == 0:  # `color_arguments`
            by_name["dc"] = by_input["shs"]
        else:
            by_name.update(dc=by_input["dc"], shs=by_input["shs"])
        for name in PARAMETERS:
            raw[name].grad = by_name.get(name)


def rounds_of(sizes: Sequence[int], processes: int) -> List[Dict[int, int]]:
    """Who blends which view, by round: in each round a view for each process, by its rank.

    sizes: of the views. The larger ones come first, and who has had a larger one takes a smaller one, so that nobody
    waits long for the others. A single round has the views in their order.
    """
    order = list(range(len(sizes)))
    if len(sizes) > processes:
        order.sort(key=lambda view: -sizes[view])
    rounds = []
    for begin in range(0, len(order), processes):
        ranks = range(processes) if len(rounds) % 2 == 0 else range(processes - 1, -1, -1)
        rounds.append(dict(zip(ranks, order[begin:begin + processes])))
    return rounds
