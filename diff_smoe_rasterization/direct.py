"""A rendering and its gradients without autograd, for a loop that knows what it wants of them."""
from __future__ import annotations

from typing import Dict, List, Optional, Sequence

import torch

from .arguments import as_rendering, op_arguments
from .autograd import IMAGES, INPUTS, OPTIONS, refuse_transforms
from .checks import check_tensors
from .core import _core
from .settings import FEATURE_OUTPUTS, GaussianRasterizationSettings, Rendering
from .splats import Splats

_OPS = torch.ops.diff_smoe_rasterization
_COLORS, _BACKGROUND, _OPACITIES = INPUTS.index("colors_precomp"), INPUTS.index("bg"), INPUTS.index("opacities")
_INSTANCES = {device: [name for name, *_ in saved].index("instances") for device, saved in _core.saved.items()}
_RADII = IMAGES.index("radii")
_KIND = [list(OPTIONS).index(name) for name in ("image_width", "image_height", "blend_mode")]
_ABSENT = [INPUTS.index(name) for name in ("means2D", "dc", "shs", "background_gate")]
_GRADIENTS = {"color": "color", "alpha": "gate_sum", **{name: name for name in FEATURE_OUTPUTS}}


class DirectRendering:
    """One rendering in three calls: which Gaussians it will show, its images, and their gradients.

    The arguments are those of `rasterize` but means2D_abs, and so are the errors and all numbers. It is for loops that
    save what autograd costs: Python's time, and a pass over memory for every gradient that is only passed on.
    """

    def __init__(self, means3D: torch.Tensor, opacities: torch.Tensor, settings: GaussianRasterizationSettings,
                 means2D: Optional[torch.Tensor] = None, dc: Optional[torch.Tensor] = None,
                 shs: Optional[torch.Tensor] = None, colors_precomp: Optional[torch.Tensor] = None,
                 scales: Optional[torch.Tensor] = None, rotations: Optional[torch.Tensor] = None,
                 cov3D_precomp: Optional[torch.Tensor] = None, outputs: Sequence[str] = ()) -> None:
        self._inputs, self._options = op_arguments(
            "DirectRendering", settings, outputs, means3D, opacities, means2D=means2D, dc=dc, shs=shs,
            colors_precomp=colors_precomp, scales=scales, rotations=rotations, cov3D_precomp=cov3D_precomp)
        refuse_transforms("DirectRendering", self._inputs)
        self._outputs, self._forgotten = outputs, False
        self._images: Optional[List[torch.Tensor]] = None

    @torch.no_grad()
    def visible_radii(self) -> torch.Tensor:
        """The radii [N] int32 that `render` will return for Gaussians of finite colours; colours are not read."""
        inputs = list(self._given("visible_radii"))
        for index in _ABSENT:
            inputs[index] = None
        # A radius does not depend on the colour. Any finite number does for one.
        inputs[_COLORS] = inputs[_OPACITIES].reshape(-1, 1)
        inputs[_BACKGROUND] = inputs[_BACKGROUND][:1]
        return _OPS.radii(*inputs, *self._options, False)

    @torch.no_grad()
    def render(self) -> Rendering:
        """The images, without gradient. Neither they nor the arguments may be changed in place before `backward`."""
        *self._images, self._saved = _OPS.rasterize(*self._given("render"), *self._options, True)
        self._versions = [_version(tensor) for tensor in (*self._inputs, *self._images)]
        return as_rendering(self._images, self._outputs)

    def splats(self) -> Splats:
        """What `rasterize_with_splats` returns beside the images, after `render`. Raises RuntimeError before it."""
        return Splats(self._rendered("splats"), self._saved, self._inputs, self._options)

    @property
    def room(self) -> int:
        """After `render`: for how many tile instances there is room. Raises RuntimeError before it."""
        kind = self._rendered("room")[_RADII].device.type
        return self._saved[_INSTANCES[kind]].numel()

    def recent_instances(self) -> int:
        """On a GPU: how many tile instances such renderings had at most lately, as far as it has counted; -1: unknown.

        The host does not wait. A captured graph whose `room` is less is slow.
        """
        count = len(self._rendered("recent_instances")[_RADII])
        return _core.recent_instances(*(self._options[index] for index in _KIND), count)

    def forget_gaussians(self) -> None:
        """Lets go of the arguments but for what `splats` takes; what needs the others raises RuntimeError from now on.

        For a caller that has captured the calls in a CUDA graph: the graph knows where the arguments lie, and they may
        be replaced before the graph is.
        """
        self._inputs = [value if name in ("bg", "background_gate") else None
                        for name, value in zip(INPUTS, self._inputs)]
        self._forgotten = True

    @torch.no_grad()
    def backward(self, dL_dimages: Dict[str, torch.Tensor], gradients: Dict[str, torch.Tensor]) -> None:
        """Writes gradients, after `render`.

        dL_dimages: by name, `color` and OUTPUTS. gradients: for the arguments whose gradients are wanted, by name, also
        bg and background_gate; dense and of their shape. Of those with a row for each Gaussian only the rows are
        written whose radius is above 0. The others stay as they are. Raises RuntimeError before `render`, and if an
        argument or an image was changed in place since.
        """
        images, inputs = self._rendered("backward"), self._given("backward")
        for name, tensor, version in zip((*INPUTS, *IMAGES), (*inputs, *images), self._versions):
            if _version(tensor) != version:
                raise RuntimeError(f"DirectRendering.backward: {name} was changed in place since render; change it "
                                   "after backward, or change a copy")
        unknown = set(gradients) - {name for name, value in zip(INPUTS, self._inputs) if value is not None}
        if unknown or not set(dL_dimages) <= set(_GRADIENTS):
            raise ValueError(f"DirectRendering.backward: dL_dimages has {', '.join(dL_dimages)} and gradients has "
                             f"{', '.join(gradients)}; they may have {', '.join(_GRADIENTS)} and arguments that "
                             "are given")
        check_tensors("DirectRendering.backward", **{
            "means3D": self._inputs[0], **{f"dL_dimages[{name!r}]": value for name, value in dL_dimages.items()},
            **{f"gradients[{name!r}]": value for name, value in gradients.items()}})
        by_image = {_GRADIENTS[name]: gradient for name, gradient in dL_dimages.items()}
        _OPS.rasterize_backward_seen(
            *(by_image.get(name) for name in IMAGES if name != "radii"),
            [value for value in self._inputs if value is not None], [value is not None for value in self._inputs],
            images, self._saved, *self._options, True, [name in gradients for name in INPUTS],
            [gradients[name] for name in INPUTS if name in gradients])

    def _given(self, function: str) -> List[Optional[torch.Tensor]]:
        if self._forgotten:
            raise RuntimeError(f"DirectRendering.{function}: forget_gaussians has let go of the arguments; call "
                               f"{function} before it")
        return self._inputs

    def _rendered(self, function: str) -> List[torch.Tensor]:
        if self._images is None:
            raise RuntimeError(f"DirectRendering.{function}: nothing is rendered yet; call render first")
        return self._images


def _version(tensor: Optional[torch.Tensor]) -> int:
    """How often a tensor was changed in place; 0 if torch does not count, as of inference tensors."""
    return 0 if tensor is None or tensor.is_inference() else tensor._version
