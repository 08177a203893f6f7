"""Steps that are alike, captured once as CUDA graphs and replayed.

With few Gaussians the card is done with a step before Python has launched the next one. A graph is launched at once. It
repeats the same kernels on the same memory, so a step is captured as long as the parameters lie where they are and the
view differs only in what is copied: matrices, image, opacity, mask and background.
"""
from __future__ import annotations

import contextlib
import dataclasses
import gc
import math
import sys
import warnings
import weakref
from typing import Any, Callable, Dict, Hashable, Iterator, List, Optional, Sequence, Tuple

import torch

from diff_smoe_rasterization.settings import GaussianRasterizationSettings

from ..errors import out_of_memory
from ..scenes.images import View

_OPS = torch.ops.diff_smoe_rasterization

WARM_UP = 64  # steps without a graph, from which the room for the lists of tile instances is learned
MOST_KINDS = 4  # that are captured at a time: each takes memory
IDLE = 512  # steps without a replay, after which a graph gives its place to another kind
MOST_SEEN = 256  # kinds that are remembered; of more than that each comes too seldom
FULL = 0.8  # a graph whose lists are filled more than this is captured anew: what they do not hold would take long
SPARE_ROOM = 1.25  # memory of graphs is for so many times the Gaussians: a densification then needs no other memory
PIXEL_BYTES = 100  # of memory, about, for an image that is rendered and differentiated

MATRICES = ("viewmatrix", "projmatrix", "campos")
PLANES = ("image", "opacity", "mask")


class Captured:
    """The three parts of a step of one kind, captured; their results lie in the same tensors at each replay."""

    def __init__(self, record: Callable[[Callable[[], Any]], Callable[[], Any]]) -> None:
        """record: runs a function to capture it, and returns what repeats it."""
        self._record = record
        self.drawn: Any = None
        self.used = 0  # the step of the training in which it was replayed last

    def copies(self, settings: GaussianRasterizationSettings, view: View, background: Optional[torch.Tensor]
               ) -> Tuple[GaussianRasterizationSettings, View, Optional[torch.Tensor]]:
        """The same settings and view with tensors of their own, into which `replay_draw` copies each view."""
        matrices = {name: getattr(settings, name).clone() for name in MATRICES}
        planes = {name: getattr(view, name) for name in PLANES}
        planes = {name: plane.clone() for name, plane in planes.items() if plane is not None}
        self._copies = [*matrices.values(), *planes.values()]
        if background is not None:
            background = background.clone()
            self._copies.append(background)
            settings = settings._replace(bg=background)
        return settings._replace(**matrices), dataclasses.replace(view, **planes), background

    def capture(self, draw: Callable[[], Any], differentiate: Callable[[Any], None], update: Callable[[], None]
                ) -> None:
        """Captures the parts: up to the loss, from there to the gradients, and to the next parameters.

        draw: its results are `drawn`, and the argument of `differentiate`.
        """

        def keep() -> None:
            self.drawn = draw()

        self._draw = self._record(keep)
        self.replay_differentiate = self._record(lambda: differentiate(self.drawn))
        self.replay_update = self._record(update)

    def replay_draw(self, numbers: torch.Tensor, new_numbers: Sequence[float], settings: GaussianRasterizationSettings,
                    view: View, background: Optional[torch.Tensor]) -> Any:
        """Copies a view and numbers, and draws; returns the results, which hold until the next replay."""
        given = [*(getattr(settings, name) for name in MATRICES), *(getattr(view, name) for name in PLANES), background]
        _OPS.set_inputs(self._copies, [tensor for tensor in given if tensor is not None], numbers, new_numbers)
        self._draw()
        return self.drawn


class NoGraphs:
    """Captures nothing."""

    def kind(self, settings: GaussianRasterizationSettings, loss_rule: Hashable, view: View,
             background: Optional[torch.Tensor]) -> Hashable:
        """What two steps must have in common so that one graph does for both."""
        return None

    def find(self, memory: Sequence[Any], kind: Hashable, capture: Callable[[Captured], None]) -> Optional[Captured]:
        """The step of this kind, captured now if need be; None if it has to be launched.

        memory: all whose tensors a step reads or writes where they lie. capture: captures a step.
        """
        return None


class Graphs(NoGraphs):
    """Captures a kind of step when it comes a second time over the same parameters.

    A capture takes as long as several steps. So a graph stays as long as it is used, and while all places are taken,
    steps of further kinds are launched.
    """

    def __init__(self) -> None:
        self._memory: List[Any] = []  # weak references
        self._captured: Dict[Hashable, Captured] = {}
        self._seen: Dict[Hashable, None] = {}  # kinds that came before
        self._steps = self._launched = 0
        self._too_many: float = math.inf  # Gaussians, with whose graphs the memory did not suffice

    def kind(self, settings: GaussianRasterizationSettings, loss_rule: Hashable, view: View,
             background: Optional[torch.Tensor]) -> Hashable:
        gate: Any = settings.background_gate
        common = settings._replace(viewmatrix=None, projmatrix=None, campos=None, bg=None,
                                   background_gate=id(gate) if isinstance(gate, torch.Tensor) else gate)
        return common, loss_rule, background is None, view.opacity is None, view.mask is None

    def find(self, memory: Sequence[Any], kind: Hashable, capture: Callable[[Captured], None]) -> Optional[Captured]:
        self._steps += 1
        if len(memory) != len(self._memory) or any(here is not ref() for here, ref in zip(memory, self._memory)):
            self._memory = [weakref.ref(here) for here in memory]
            self._captured.clear()
            self._seen.clear()
        found = self._captured.get(kind)
        if found is not None and self._is_full(found):
            del self._captured[kind]
            self._seen.pop(kind, None)  # launched once more, which learns how much room it needs
            found = None
        if found is None and self._is_due(kind):
            found = self._capture(len(memory[0]), capture)
            if found is not None:
                self._captured[kind] = found
        if found is None:
            self._launched += 1
            self._seen[kind] = None
            while len(self._seen) > MOST_SEEN:
                del self._seen[next(iter(self._seen))]
        else:
            found.used = self._steps
        return found

    def _is_due(self, kind: Hashable) -> bool:
        """Whether a kind without a graph is to be captured: it came before, and there is a place for it."""
        if kind not in self._seen or self._launched < WARM_UP:
            return False
        self._captured = {other: graph for other, graph in self._captured.items() if self._steps - graph.used <= IDLE}
        return len(self._captured) < MOST_KINDS

    def _capture(self, num_gaussians: int, capture: Callable[[Captured], None]) -> Optional[Captured]:
        """A new step; None if the memory does not suffice, also when all other graphs are gone."""
        if num_gaussians >= self._too_many:
            return None
        for _ in range(2):
            try:
                return self._new(num_gaussians, capture)
            except Exception as error:
                if out_of_memory(error) is None:
                    raise
            self._free()  # here, as the error holds what the capture had
        self._too_many = num_gaussians
        print(f"dsmoe train: at {num_gaussians} Gaussians the GPU has no memory for steps as CUDA graphs; while there "
              "are not fewer, steps are launched one by one, which may take longer", file=sys.stderr)
        return None

    def _free(self) -> None:
        """Lets go of all graphs."""
        self._captured.clear()

    def _is_full(self, captured: Captured) -> bool:
        """Whether a late replay had nearly more tile instances than there is room for."""
        return False

    def _new(self, num_gaussians: int, capture: Callable[[Captured], None]) -> Captured:
        captured = Captured(self._record)
        capture(captured)
        return captured

    def _record(self, function: Callable[[], Any]) -> Callable[[], Any]:
        """Here the function runs anew at each replay: for tests without a GPU."""
        return function


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Python's collector waits: graphs of other trainings that it found would be freed, which a capture forbids."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class CudaGraphs(Graphs):
    """The same by CUDA's graphs, which have a pool of memory of their own."""

    def __init__(self, device: torch.device) -> None:
        super().__init__()
        self._device = device
        self._stream = torch.cuda.Stream(device)
        self._pool: Any = None
        self._keeper: Any = None  # a graph that keeps the pool if all others are gone
        self._room = 0.0  # Gaussians that the pool has memory for
        self._bytes = 0.0  # that the graphs take for each Gaussian
        self._reserve = 0  # bytes that the pool began with

    def _new(self, num_gaussians: int, capture: Callable[[Captured], None]) -> Captured:
        fresh = num_gaussians > self._room
        if fresh:
            self._begin_pool(num_gaussians)
        before = torch.cuda.memory_reserved(self._device) - self._reserve
        captured = super()._new(num_gaussians, capture)
        captured.drawn.direct.forget_gaussians()
        if fresh:
            color = captured.drawn.rendering.color
            taken = torch.cuda.memory_reserved(self._device) - before - PIXEL_BYTES * color[0].numel()
            self._bytes = max(taken, 0) / num_gaussians
        return captured

    def _free(self) -> None:
        super()._free()
        self._pool = self._keeper = None
        self._room = self._bytes = 0.0
        torch.cuda.empty_cache()  # during a capture torch does not free what it has cached

    def _is_full(self, captured: Captured) -> bool:
        direct = captured.drawn.direct
        return direct.recent_instances() > FULL * direct.room

    def _begin_pool(self, num_gaussians: int) -> None:
        """Begins a pool for more Gaussians, and gives the one before back to the driver."""
        had_one = self._keeper is not None
        self._keeper = None
        if had_one:
            torch.cuda.empty_cache()
        self._room = SPARE_ROOM * num_gaussians
        self._pool = torch.cuda.graph_pool_handle()
        self._reserve, place = int(self._bytes * self._room), torch.zeros(1, device=self._device)

        def keep() -> None:
            torch.empty(self._reserve, dtype=torch.uint8, device=self._device)  # freed at once: the pool has it
            place.zero_()

        self._keeper = self._record_graph(keep)

    def _record(self, function: Callable[[], Any]) -> Callable[[], Any]:
        return self._record_graph(function).replay

    def _record_graph(self, function: Callable[[], Any]) -> Any:
        # Not torch.cuda.graph, which waits for the device and frees all cached memory first.
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.stream(self._stream), _no_collection():
            try:  # other threads may use the device meanwhile
                graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
            except TypeError:  # torch before 2.1
                graph.capture_begin(pool=self._pool)
            try:
                function()
            except BaseException:  # it says what is wrong; the end of a broken capture would say less
                with contextlib.suppress(RuntimeError), warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # torch's, that the graph is empty
                    graph.capture_end()
                raise
            graph.capture_end()
        return graph
