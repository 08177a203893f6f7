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
from typing import Any, Callable, Dict, Hashable, Iterator, List, Optional, Sequence

import torch

from ..errors import out_of_memory
from .step_parts import Compare, Drawn, Frame, Numbers, StepParts, ViewOver

WARM_UP = 64  # steps without a graph, from which the room for the lists of tile instances is learned
MOST_KINDS = 4  # that are captured at a time: each takes memory
IDLE = 512  # steps without a replay, after which a graph gives its place to another kind
MOST_SEEN = 256  # kinds that are remembered; of more than that each comes too seldom
FULL = 0.8  # a graph whose lists are filled more than this is captured anew: what they do not hold would take long
SPARE_ROOM = 1.25  # memory of graphs is for so many times the Gaussians: a densification then needs no other memory
PIXEL_BYTES = 100  # of memory, about, for an image that is rendered and differentiated

MATRICES = ("viewmatrix", "projmatrix", "campos")
PLANES = ("image", "opacity", "mask")


class Captured(StepParts):
    """The parts of steps of one kind, captured; their results lie in the same tensors at each replay."""

    def __init__(self, launched: StepParts, frame: Frame, compare: Compare,
                 record: Callable[[Callable[[], None]], Callable[[], None]]) -> None:
        """Nothing is computed. record: runs a function to capture it, and returns what repeats it."""
        self.numbers = launched.numbers
        self._copies = [tensor.clone() for tensor in _varying(frame)]
        own = _with_varying(frame, self._copies)
        self.used = 0  # the step of the training in which it was replayed last

        def draw() -> None:
            self.drawn = launched.draw(own, compare)

        self._draw = record(draw)
        self._differentiate = record(lambda: launched.differentiate(self.drawn))
        self._update = record(lambda: launched.update(self.drawn.rendering.radii))

    def send(self, frame: Frame, numbers: Numbers) -> None:
        self.numbers.send(numbers, self._copies, _varying(frame))

    def draw(self, frame: Frame, compare: Compare) -> Drawn:
        self._draw()
        return self.drawn

    def differentiate(self, drawn: Drawn) -> None:
        self._differentiate()

    def update(self, radii: torch.Tensor) -> None:
        self._update()


def _varying(frame: Frame) -> List[torch.Tensor]:
    """The tensors in which frames of one kind differ."""
    (view, background), settings = frame
    tensors = [*(getattr(settings, name) for name in MATRICES), *(getattr(view, name) for name in PLANES), background]
    return [tensor for tensor in tensors if tensor is not None]


def _with_varying(frame: Frame, tensors: Sequence[torch.Tensor]) -> Frame:
    """The frame with others in place of what `_varying` gives."""
    (view, background), settings = frame
    others = iter(tensors)
    settings = settings._replace(**{name: next(others) for name in MATRICES})
    view = dataclasses.replace(view, **{name: next(others) for name in PLANES if getattr(view, name) is not None})
    if background is not None:
        background = next(others)
        settings = settings._replace(bg=background)
    return Frame(ViewOver(view, background), settings)


def _kind_of(frame: Frame, loss_rule: Hashable) -> Hashable:
    """What two steps must have in common so that one graph does for both."""
    (view, background), settings = frame
    gate: Any = settings.background_gate
    common = settings._replace(viewmatrix=None, projmatrix=None, campos=None, bg=None,
                               background_gate=id(gate) if isinstance(gate, torch.Tensor) else gate)
    return common, loss_rule, background is None, view.opacity is None, view.mask is None


class NoGraphs:
    """Captures nothing."""

    def parts(self, launched: StepParts, frame: Frame, compare: Compare, loss_rule: Hashable, memory: Sequence[Any]
              ) -> StepParts:
        """A step like this one, captured now if need be, or the one that launches.

        memory: all whose tensors a step reads or writes where they lie.
        """
        return launched


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

    def parts(self, launched: StepParts, frame: Frame, compare: Compare, loss_rule: Hashable, memory: Sequence[Any]
              ) -> StepParts:
        return self._find(memory, _kind_of(frame, loss_rule),
                          lambda: Captured(launched, frame, compare, self._record)) or launched

    def _find(self, memory: Sequence[Any], kind: Hashable, capture: Callable[[], Captured]) -> Optional[Captured]:
        """The step of this kind, captured now if need be; None if it has to be launched."""
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

    def _capture(self, num_gaussians: int, capture: Callable[[], Captured]) -> Optional[Captured]:
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

    def _new(self, num_gaussians: int, capture: Callable[[], Captured]) -> Captured:
        return capture()

    def _record(self, function: Callable[[], None]) -> Callable[[], None]:
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

    def _new(self, num_gaussians: int, capture: Callable[[], Captured]) -> Captured:
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

    def _record(self, function: Callable[[], None]) -> Callable[[], None]:
        return self._record_graph(function).replay

    def _record_graph(self, function: Callable[[], None]) -> Any:
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
