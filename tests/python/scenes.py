"""Random scenes for the tests: a camera that looks at a cloud of Gaussians, some behind it, some out of its sight."""
from __future__ import annotations

import math
from typing import Dict, NamedTuple

import pytest
import torch
from devices import default_device, random_normal

from diff_smoe_rasterization.core import _core
from diff_smoe_rasterization.settings import (
    BLEND_MODES,
    FEATURE_OUTPUTS,
    GaussianRasterizationSettings,
    resolve_background_gate,
    resolve_faint_below,
    resolve_lens,
    resolve_shutter,
)

CAMERA_FIELDS = ("bg", "viewmatrix", "projmatrix", "campos", "viewmatrix_end")
BACKGROUND_GATES = {"eq7_gate": ("smoe_eq7", 0.05), "smoe_learned_gate": ("smoe", torch.tensor(0.25, device="cpu"))}
"""Further modes of the tests: a blend mode and its background gate, a number and a tensor."""
with_gate = pytest.mark.parametrize("mode", BLEND_MODES + ("smoe_learned_gate",))
with_gates = pytest.mark.parametrize("mode", BLEND_MODES + tuple(BACKGROUND_GATES))
REMOVABLE_MODES = tuple(mode for mode in BLEND_MODES if _core.blend_modes[mode]["removable"])
"""Those that `importance` takes."""
with_removal = pytest.mark.parametrize("mode", REMOVABLE_MODES + ("smoe_learned_gate",))


def gate_of(mode):
    """Returns lambda, by which a mode weighs the background: a number."""
    return 1.0 if mode == "alpha" else float(BACKGROUND_GATES.get(mode, ("", 0.0))[1])


def blend_of(mode):
    """Returns the blend mode of a mode of the tests."""
    return BACKGROUND_GATES[mode][0] if mode in BACKGROUND_GATES else mode


def spread(tensor):
    """Returns the tensor as every second column of a wider one, whose others must not be read."""
    fill = float("nan") if tensor.is_floating_point() else -1
    wider = torch.full(tensor.shape[:-1] + (2 * tensor.shape[-1] + 1,), fill, dtype=tensor.dtype)
    columns = wider[..., 1::2]
    columns.copy_(tensor.detach())
    return columns


class Scene(NamedTuple):
    """Arguments of one call of `rasterize`."""

    inputs: Dict[str, torch.Tensor]
    settings: GaussianRasterizationSettings

    def camera(self):
        """Returns the tensors of the settings by name, a background gate among them."""
        fields = {name: getattr(self.settings, name) for name in CAMERA_FIELDS + ("background_gate",)}
        return {name: tensor for name, tensor in fields.items() if isinstance(tensor, torch.Tensor)}

    def to(self, target):
        """Returns the scene with every tensor of the given type or on the given device."""
        camera = {name: tensor.detach().to(target) for name, tensor in self.camera().items()}
        inputs = {name: tensor.detach().to(target) for name, tensor in self.inputs.items()}
        return Scene(inputs, self.settings._replace(**camera))

    def with_settings(self, **fields):
        return self._replace(settings=self.settings._replace(**fields))

    def with_inputs(self, **tensors):
        return self._replace(inputs={**self.inputs, **tensors})

    def rows(self, index):
        """Returns the scene with a selection of its Gaussians."""
        return self._replace(inputs={name: tensor[index] for name, tensor in self.inputs.items()})

    def requiring_grad(self, camera=True):
        """Returns the scene with every tensor a fresh leaf that requires its gradient; camera: CAMERA_FIELDS too."""
        inputs = {name: tensor.detach().clone().requires_grad_(True) for name, tensor in self.inputs.items()}
        fields = {name: tensor.detach().clone().requires_grad_(True) for name, tensor in self.camera().items()
                  if camera or name not in CAMERA_FIELDS}
        return Scene(inputs, self.settings._replace(**fields))

    def leaves(self):
        """Returns the tensors that require their gradient, by name."""
        return {name: tensor for name, tensor in {**self.inputs, **self.camera()}.items() if tensor.requires_grad}


def without_tails(scene):
    """Returns the scene without the tails of `smoe`, whose sum the gradients hold constant: for finite differences."""
    return scene.with_settings(faint_below=0.0)


def camera_settings(width, height, position=(0.4, -0.3, -4.0), fov_x=0.9, principal_point=(0.0, 0.0), degree=0, bg=None,
                    dtype=torch.float64, blend_mode=None, **fields):
    """Returns settings of a camera that looks from position to the origin, matrices transposed as trainers pass them.

    principal_point: offset from the image centre in pixels. blend_mode: may be a name from BACKGROUND_GATES.
    """
    if blend_mode in BACKGROUND_GATES:
        blend_mode, gate = BACKGROUND_GATES[blend_mode]
        fields["background_gate"] = gate.to(default_device(), dtype) if isinstance(gate, torch.Tensor) else gate
    position = torch.tensor(position, dtype=torch.float64)
    forward = -position / position.norm()
    right = torch.linalg.cross(torch.tensor([0.1, 1.0, 0.0], dtype=torch.float64), forward)
    right = right / right.norm()
    down = torch.linalg.cross(forward, right)
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = torch.stack([right, down, forward], 1)
    view[3, :3] = -position @ view[:3, :3]

    tanfovx = math.tan(fov_x / 2)
    tanfovy = tanfovx * height / width
    near, far = 0.01, 100.0
    projection = torch.zeros(4, 4, dtype=torch.float64)
    projection[0, 0], projection[1, 1] = 1 / tanfovx, 1 / tanfovy
    projection[2, 0], projection[2, 1] = 2 * principal_point[0] / width, 2 * principal_point[1] / height
    projection[2, 2], projection[2, 3], projection[3, 2] = far / (far - near), 1, -far * near / (far - near)

    bg = torch.tensor([0.2, 0.5, 0.8]) if bg is None else bg
    return GaussianRasterizationSettings(
        image_height=height, image_width=width, tanfovx=tanfovx, tanfovy=tanfovy, bg=bg.to(dtype), scale_modifier=1.0,
        viewmatrix=view.to(dtype), projmatrix=(view @ projection).to(dtype), sh_degree=degree,
        campos=position.to(dtype), prefiltered=False, debug=False, blend_mode=blend_mode, **fields)


def turned(view, angles, shift):
    """Returns a view matrix, transposed, after a further turn around x, y and z and a shift, both in view space."""
    x, y, z = angles
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64))
    turn = turn.to(view)
    return torch.cat([torch.cat([view[:3, :3] @ turn.T, (view[3:, :3] @ turn.T) + view.new_tensor([shift])]),
                      view[:, 3:]], 1)


def random_scene(mode, num_gaussians=120, width=50, height=37, seed=0, degree=2, channels=None, covariance="scales",
                 split_dc=False, scale=0.12, opacity=(0.02, 1.2), dtype=torch.float64, **camera):
    """Returns a scene of a random cloud in a box that is larger than the view, so that about a third is out of sight.

    channels: number of channels of colors_precomp; None for spherical harmonics.
    covariance: "scales" for scales and rotations, "cov3D" for cov3D_precomp.
    scale: median standard deviation, world; axes vary by a factor of 3 up and down.
    Every value is a float32 number, so that the same scene exists in both types, and drawn on the CPU, so that it is
    the same on every device.
    """
    generator = torch.Generator(device="cpu").manual_seed(seed)

    def uniform(low, high, *shape):
        return (low + (high - low) * torch.rand(*shape, generator=generator, device="cpu")).to(default_device())

    def normal(*shape):
        return torch.randn(*shape, generator=generator, device="cpu").to(default_device())

    means3D = uniform(-2.2, 2.2, num_gaussians, 3)
    means3D[: num_gaussians // 12] -= torch.tensor([0.0, 0.0, 6.0])
    inputs = {"means3D": means3D, "means2D": torch.zeros(num_gaussians, 3),
              "opacities": uniform(opacity[0], opacity[1], num_gaussians, 1)}
    if channels is not None:
        inputs["colors_precomp"] = uniform(0.0, 1.0, num_gaussians, channels)
        camera.setdefault("bg", uniform(0.0, 1.0, channels))
    else:
        shs = 0.4 * normal(num_gaussians, (degree + 1) ** 2, 3)
        if split_dc:
            inputs["dc"], inputs["shs"] = shs[:, :1].contiguous(), shs[:, 1:].contiguous()
        else:
            inputs["shs"] = shs
    scales = scale * torch.exp(uniform(-1.1, 1.1, num_gaussians, 3))
    rotations = normal(num_gaussians, 4)
    rotations = uniform(0.95, 1.05, num_gaussians, 1) * rotations / rotations.norm(dim=1, keepdim=True)
    if covariance == "scales":
        inputs["scales"], inputs["rotations"] = scales, rotations
    else:
        axes = torch.linalg.qr(normal(num_gaussians, 3, 3))[0] * scales[:, None, :]
        full = axes @ axes.transpose(1, 2)
        inputs["cov3D_precomp"] = torch.stack([full[:, i, j] for i in range(3) for j in range(i, 3)], 1)
    settings = camera_settings(width, height, degree=degree, dtype=torch.float32, blend_mode=mode, **camera)
    return Scene(inputs, settings).to(dtype)


def assert_not_empty(rendering, settings):
    """Fails for a scene that tests nothing: nothing visible, nothing culled, or an image that is all background."""
    assert (rendering.radii > 0).sum() >= 5
    background = settings.bg.detach()[:, None, None]
    covered = ((rendering.color.detach() - background).abs() > 1e-3).any(0).double().mean()
    assert covered > 0.3, f"only {covered:.0%} of the pixels differ from the background"


def random_weights(rendering, outputs=(), seed=1):
    """Returns fixed random gradients [C, H, W], ... for the colour and the optional outputs of a rendering."""
    images = [rendering.color] + [getattr(rendering, name) for name in outputs]
    return images, [random_normal(image.shape, seed + i).to(image) for i, image in enumerate(images)]


def gradients(function, scene, outputs=(), camera=True):
    """Renders with `function`, returns (rendering, gradients by name) for fixed random image gradients; None is 0."""
    scene = scene.requiring_grad(camera)
    rendering = function(settings=scene.settings, outputs=outputs, **scene.inputs)
    images, weights = random_weights(rendering, outputs)
    leaves = scene.leaves()
    values = torch.autograd.grad(images, list(leaves.values()), weights, allow_unused=True)
    return rendering, {name: torch.zeros_like(leaf) if value is None else value
                       for (name, leaf), value in zip(leaves.items(), values)}


def transmittance_of(scene):
    """Returns T behind the last pair of each pixel [H, W]; what is saved of it is negative in wide pixels."""
    return op_results(scene)[1]["final_transmittance"].abs().reshape(scene.settings.image_height, -1)


def op_arguments(scene, op="rasterize", **others):
    """Returns the arguments of an op for a scene and all optional images, by the op's schema; others: by name."""
    mode = scene.settings.blend_mode
    gate = resolve_background_gate(mode, scene.settings.background_gate)
    learned = isinstance(gate, torch.Tensor)
    camera_model, lens = resolve_lens(scene.settings)
    values = {**scene.settings._asdict(), "blend_mode": BLEND_MODES.index(mode), "camera_model": camera_model,
              "lens": lens, "rolling_shutter": resolve_shutter(scene.settings),
              "faint_below": resolve_faint_below(mode, scene.settings.faint_below),
              **dict.fromkeys(FEATURE_OUTPUTS, True),
              "background_gate": gate if learned else None, "fixed_background_gate": 0.0 if learned else gate,
              "for_backward": True, **scene.inputs, **others}
    schema = getattr(torch.ops.diff_smoe_rasterization, op).default._schema
    return tuple(values.get(argument.name) for argument in schema.arguments)


def op_results(scene, **others):
    """Calls the op `rasterize` as `op_arguments` says. Returns its images and its saved tensors, each by name."""
    from diff_smoe_rasterization.core import _core

    *images, saved = torch.ops.diff_smoe_rasterization.rasterize(*op_arguments(scene, **others))
    names = [name for name, _, _ in _core.saved[images[0].device.type]]
    return dict(zip(_core.images, images)), dict(zip(names, saved))
