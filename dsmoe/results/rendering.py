"""One image of a GaussianModel through the rasterizer."""
from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, Callable, Dict, Optional, Sequence, Tuple

import torch

from diff_smoe_rasterization.settings import (
    GATED_MODES,
    BackgroundGate,
    GaussianRasterizationSettings,
    Rendering,
    trained_faint_below,
)

from ..model import GaussianModel
from ..scenes.cameras import Camera

if TYPE_CHECKING:
    from diff_smoe_rasterization.splats import Splats

Rasterize = Callable[..., Rendering]


def package_rasterizer() -> Rasterize:
    """The compiled `rasterize`; imported late, so that scenes and configs work without the extension."""
    from diff_smoe_rasterization import rasterize

    return rasterize


def _rasterize_around(means3D: torch.Tensor, opacities: torch.Tensor, settings: GaussianRasterizationSettings,
                      outputs: Sequence[str] = (), **arguments: Any) -> Rendering:
    """`rasterize` of a panorama, without a seam."""
    from diff_smoe_rasterization import blend_footprints, project_gaussians

    footprints = project_gaussians(means3D, opacities, settings, outputs=outputs, **arguments)
    rendering = blend_footprints(footprints.around(settings.image_width), settings, outputs)
    return rendering._replace(radii=footprints.radii)


class Renderer:
    """Renders a model with one blend mode and background; the only place where the settings of a view are made."""

    def __init__(self, model: GaussianModel, blend_mode: str, background: torch.Tensor,
                 antialiasing: bool = False, rasterize: Optional[Rasterize] = None, *,
                 background_gate: BackgroundGate, faint_below: Optional[float] = None,
                 deterministic: bool = False) -> None:
        """background: [3] on the model's device. rasterize: by default the package's.

        background_gate, faint_below: of GATED_MODES. A tensor has no gradient, and may change. faint_below None: the
        mode's usual number, whatever $DSMOE_FAINT_BELOW says.
        """
        self.model = model
        self.blend_mode = blend_mode
        self.background = background
        self.background_gate = background_gate
        self.faint_below = faint_below
        self.antialiasing = antialiasing
        self.deterministic = deterministic
        self.rasterize = rasterize or package_rasterizer()
        self._settings: Dict[int, Tuple[Camera, GaussianRasterizationSettings]] = {}

    def __call__(self, camera: Camera, background: Optional[torch.Tensor] = None,
                 background_gate: Optional[torch.Tensor] = None, **arguments: Any) -> Rendering:
        """background, background_gate: for this image, in place of the renderer's.

        arguments: further ones of `rasterize`, means2D or outputs, or colors_precomp in place of the SH colours.
        """
        function = self.rasterize
        if camera.is_panorama and function is package_rasterizer():
            function = _rasterize_around
        return self._render(function, camera, background, background_gate, **arguments)

    def with_splats(self, camera: Camera, background: Optional[torch.Tensor] = None,
                    background_gate: Optional[torch.Tensor] = None,
                    **arguments: Any) -> Tuple[Rendering, Splats]:
        """An image by the package's rasterizer, and what its pixels say of each Gaussian."""
        from diff_smoe_rasterization import rasterize_with_splats

        return self._render(rasterize_with_splats, camera, background, background_gate, **arguments)

    def of(self, model: GaussianModel, background_gate: BackgroundGate) -> Renderer:
        """A renderer of another model, with all else as here."""
        other = copy.copy(self)
        other.model, other.background_gate = model, background_gate
        return other

    def blend_by(self, blend_mode: str, background_gate: BackgroundGate) -> None:
        """Changes the blend of the images to come."""
        self.blend_mode, self.background_gate = blend_mode, background_gate
        self._settings.clear()

    def _render(self, function: Callable[..., Any], camera: Camera, background: Optional[torch.Tensor] = None,
                background_gate: Optional[torch.Tensor] = None, **arguments: Any) -> Any:
        model = self.model
        settings = self.settings_of(camera, background, background_gate)
        if "colors_precomp" not in arguments:
            arguments.update(model.color_arguments())
        opacities, scales, rotations = model.activated()
        return function(model.raw["means3D"], opacities, settings, scales=scales, rotations=rotations, **arguments)

    def prepare(self, cameras: Sequence[Camera]) -> None:
        """Makes the settings of all cameras, whose matrices go to the device at once.

        Else each rendering by a new camera would send its own, for which the host waits until the device is idle.
        """
        if not cameras:
            return
        made = [camera.settings(self.background.cpu(), 0, self.blend_mode, self.antialiasing) for camera in cameras]
        rows = [torch.cat([one.viewmatrix.flatten(), one.projmatrix.flatten(), one.campos, one.campos.new_zeros(1)])
                for one in made]  # with the last number each tensor begins at a multiple of 16 bytes
        sent = torch.stack(rows).to(self.background.device)
        for camera, one, row in zip(cameras, made, sent):
            self._settings[id(camera)] = (camera, one._replace(
                bg=self.background, viewmatrix=row[:16].view(4, 4), projmatrix=row[16:32].view(4, 4),
                campos=row[32:35]))

    def settings_of(self, camera: Camera, background: Optional[torch.Tensor] = None,
                    background_gate: Optional[torch.Tensor] = None) -> GaussianRasterizationSettings:
        """The camera's settings; its matrices stay on the device: sending them anew would hold up the step.

        background, background_gate: in place of the renderer's.
        """
        if id(camera) not in self._settings:  # kept with its camera, so that no other one gets this id
            self._settings[id(camera)] = (camera, camera.settings(self.background, 0, self.blend_mode,
                                                                  self.antialiasing))
        changes: Dict[str, Any] = {"sh_degree": self.model.active_sh_degree, "deterministic": self.deterministic}
        if background is not None:
            changes["bg"] = background
        if self.blend_mode in GATED_MODES:
            changes["background_gate"] = self.background_gate if background_gate is None else background_gate
            changes["faint_below"] = trained_faint_below(self.blend_mode, self.faint_below)
        return self._settings[id(camera)][1]._replace(**changes)


def background_color(white: bool, device: str) -> torch.Tensor:
    """[3] white or black."""
    return torch.full((3,), 1.0 if white else 0.0, device=device)
