"""The rasterizers that gpu_rasterizer.py times: how each is called. Nothing of a peer's is here but its interface.

A peer is imported from the folder of its name below --peers-path, by the process that measures only it: several of
them share one module name. What all get: activated float32 parameters (raw ones if a peer's interface takes raw
ones), the same cameras, a black background and the near plane of 3DGS, 0.2.
"""
from __future__ import annotations

import importlib
from typing import Dict, List, Type

import torch
from models import Model, mode_and_gate

from diff_smoe_rasterization.settings import resolve_faint_below
from dsmoe.scenes.cameras import Camera

NEAR = 0.2
FAR = 1e4  # for the peers that take a far plane; beyond every Gaussian


class Renderer:
    """A rasterizer with its parameters on the GPU, prepared for every view of a model."""

    folder = ""  # of the peer's package; empty: it is this project
    note = ""
    has_backward = True
    is_alpha = True  # renders by Eq. 3, so that its image can be compared with another's

    def __init__(self, model: Model):
        self.parameters = {name: tensor.requires_grad_(self.has_backward)
                           for name, tensor in self.make_parameters(model.inputs).items()}
        self.views = [self.make_view(model, view) for view in range(len(model.cameras))]

    def make_parameters(self, inputs: Dict[str, torch.Tensor]) -> Dict[str, torch.Tensor]:
        """The leaves; `means3D` is among them."""
        return {name: tensor.detach().clone() for name, tensor in inputs.items()}

    def make_view(self, model: Model, view: int):
        raise NotImplementedError

    def render(self, view):
        """Returns what the backward pass starts from, or the image if there is none."""
        raise NotImplementedError

    def image(self, output: torch.Tensor) -> torch.Tensor:
        """[3, H, W] of an output."""
        return output

    def output_gradient(self, dL_dimage: torch.Tensor) -> torch.Tensor:
        """dL_dimage [3, H, W] in the layout of the output."""
        return dL_dimage

    def gradients(self, output: torch.Tensor, dL_doutput: torch.Tensor) -> List[torch.Tensor]:
        """Of all parameters, in their order."""
        return torch.autograd.grad(output, list(self.parameters.values()), dL_doutput)


class WithMeans2D(Renderer):
    """Also makes the gradient of means2D, as a trainer needs it."""

    def make_parameters(self, inputs):
        parameters = super().make_parameters(inputs)
        return {**parameters, "means2D": torch.zeros_like(parameters["means3D"])}


class Ours(WithMeans2D):
    """This project, one of its blends."""

    blend = "alpha"
    more_settings: Dict[str, object] = {}

    def __init__(self, model: Model):
        from diff_smoe_rasterization import rasterize
        self.rasterize = rasterize
        super().__init__(model)

    def make_view(self, model, view):
        return model.settings(view, self.blend)._replace(**self.more_settings)

    def render(self, view):
        return self.rasterize(settings=view, **self.parameters).color


# What may stand behind a blend in a renderer's name: "covered" leaves faint pairs out of covered pixels in smoe_eq7.
MORE_SETTINGS: Dict[str, Dict[str, object]] = {
    "": {}, "deterministic": {"deterministic": True}, "covered": {"faint_below": resolve_faint_below("smoe", None)}}


def ours(name: str) -> Type[Ours]:
    """Of a name such as "ours smoe:0.05 deterministic" or "ours smoe_eq7 covered". Raises ValueError."""
    word, _, rest = name.partition(" ")
    blend, _, how = rest.partition(" ")
    if word != "ours" or how not in MORE_SETTINGS:
        raise ValueError(f"{name} is not a renderer")
    mode_and_gate(blend)
    return type(name, (Ours,), {"blend": blend, "more_settings": MORE_SETTINGS[how], "is_alpha": blend == "alpha"})


class Inria(WithMeans2D):
    """diff-gaussian-rasterization of 2023, and the base of what is derived from it."""

    folder = "inria"
    settings_fields = ("image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix",
                       "projmatrix", "sh_degree", "campos", "prefiltered", "debug")
    more_settings: Dict[str, object] = {}
    more_arguments: Dict[str, torch.Tensor] = {}

    def __init__(self, model: Model):
        self.module = importlib.import_module("diff_gaussian_rasterization")
        super().__init__(model)

    def make_view(self, model, view):
        ours = model.settings(view, "alpha")
        settings = {name: getattr(ours, name) for name in self.settings_fields}
        return self.module.GaussianRasterizer(self.module.GaussianRasterizationSettings(**settings,
                                                                                       **self.more_settings))

    def render(self, view):
        return view(**self.parameters, **self.more_arguments)[0]


class InriaAntialiasing(Inria):
    """Its branch dr_aa of 2024, antialiasing off."""

    folder = "dr_aa"
    more_settings = {"antialiasing": False}


class Accelerated(InriaAntialiasing):
    """Its branch 3dgs_accel, the kernels of Taming 3DGS."""

    folder = "accel"

    def make_parameters(self, inputs):
        parameters = super().make_parameters(inputs)
        shs = parameters.pop("shs")
        return {**parameters, "dc": shs[:, :1].contiguous(), "shs": shs[:, 1:].contiguous()}


class Speedy(Inria):
    folder = "speedy"
    note = "waits for the GPU in its forward (its own timer); also makes gradients of pruning scores"

    def __init__(self, model: Model):
        self.more_arguments = {"scores": torch.zeros_like(model.inputs["opacities"])}
        super().__init__(model)


class FasterGS(Renderer):
    folder = "fastergs"
    note = "takes raw parameters: activations and their derivatives are in its times"

    def __init__(self, model: Model):
        self.module = importlib.import_module("FasterGSCudaBackend.torch_bindings")
        self.no_densification = torch.empty(0)
        super().__init__(model)

    def make_parameters(self, inputs):
        shs = inputs["shs"].detach()
        return dict(means3D=inputs["means3D"].detach().clone(), scales=torch.log(inputs["scales"]),
                    rotations=inputs["rotations"].detach().clone(), opacities=torch.logit(inputs["opacities"], 1e-6),
                    dc=shs[:, :1].contiguous(), shs=shs[:, 1:].contiguous())

    def make_view(self, model, view):
        camera, settings = model.cameras[view], model.settings(view, "alpha")
        coefficients = (model.sh_degree + 1) ** 2
        return self.module.RasterizerSettings(
            settings.viewmatrix.T.contiguous(), settings.campos, settings.bg, coefficients, camera.width, camera.height,
            camera.fx, camera.fy, camera.width / 2, camera.height / 2, NEAR, FAR, False)

    def render(self, view):
        p = self.parameters
        return self.module.diff_rasterize(p["means3D"], p["scales"], p["rotations"], p["opacities"], p["dc"], p["shs"],
                                          self.no_densification, view)


class FasterGSInference(FasterGS):
    has_backward = False
    note = "its path for rendering only; takes raw parameters"

    def render(self, view):
        p = self.parameters
        return self.module.rasterize(p["means3D"], p["scales"], p["rotations"], p["opacities"], p["dc"], p["shs"], view,
                                     True, False)


def intrinsics_of(camera: Camera, device: torch.device) -> torch.Tensor:
    """[3, 3]; the principal point is the image centre, as a packed model has it."""
    return torch.tensor([[camera.fx, 0, camera.width / 2], [0, camera.fy, camera.height / 2], [0, 0, 1]], device=device)


class Gsplat(Renderer):
    folder = "gsplat"
    packed = True

    def __init__(self, model: Model):
        self.rasterization = importlib.import_module("gsplat.rendering").rasterization
        super().__init__(model)

    def make_parameters(self, inputs):
        parameters = super().make_parameters(inputs)
        return {**parameters, "opacities": parameters["opacities"][:, 0].contiguous()}

    def make_view(self, model, view):
        camera, settings = model.cameras[view], model.settings(view, "alpha")
        intrinsics = intrinsics_of(camera, settings.bg.device)
        return dict(viewmats=settings.viewmatrix.T[None].contiguous(), Ks=intrinsics[None], width=camera.width,
                    height=camera.height, near_plane=NEAR, sh_degree=model.sh_degree, packed=self.packed)

    def render(self, view):
        p = self.parameters
        return self.rasterization(means=p["means3D"], quats=p["rotations"], scales=p["scales"],
                                  opacities=p["opacities"], colors=p["shs"], **view)[0]

    def image(self, output):
        return output[0].permute(2, 0, 1)

    def output_gradient(self, dL_dimage):
        return dL_dimage.permute(1, 2, 0)[None].contiguous()


class GsplatUnpacked(Gsplat):
    packed = False
    note = "packed=False, as its own trainer has it"


class GsplatInference(Renderer):
    """HiGS, gsplat's renderer for inference."""

    folder = "gsplat"
    has_backward = False
    note = "half-precision scene, packed beforehand and not timed; half-precision image"

    def __init__(self, model: Model):
        experimental = importlib.import_module("gsplat.experimental")
        m = model.inputs
        scene = experimental.GaussianInferenceScene.from_gaussian_tensors(
            m["means3D"], m["rotations"], m["scales"], m["opacities"][:, 0], m["shs"], model.sh_degree, "none", id="0")
        self.renderer = experimental.GaussianInferenceRenderer(scene)
        super().__init__(model)

    def make_parameters(self, inputs):
        return {}

    def make_view(self, model, view):
        camera, settings = model.cameras[view], model.settings(view, "alpha")
        intrinsics = intrinsics_of(camera, settings.bg.device)
        return dict(viewmat=settings.viewmatrix.T.contiguous(), K=intrinsics, width=camera.width,
                    height=camera.height, near_plane=NEAR)

    def render(self, view):
        with torch.inference_mode():
            return self.renderer.render(**view).frame

    def image(self, output):
        return output[0, :, :, :3].float().permute(2, 0, 1)


RENDERERS = {
    "inria": Inria,
    **{name: ours(name) for name in ("ours alpha", "ours smoe", "ours smoe_eq7:0.03", "ours smoe_eq7",
                                     "ours smoe_tn", "ours smoe_std", "ours alpha deterministic",
                                     "ours smoe deterministic")},
    "dr_aa": InriaAntialiasing, "accel": Accelerated, "speedy": Speedy, "fastergs": FasterGS,
    "fastergs inference": FasterGSInference, "gsplat": Gsplat, "gsplat unpacked": GsplatUnpacked,
    "higs": GsplatInference,
}
"""By the name in the tables. Inria's comes first: the images and gradients of the others are compared with its."""


def renderer_named(name: str) -> Type[Renderer]:
    """One of RENDERERS, or ours with another blend. Raises ValueError."""
    return RENDERERS.get(name) or ours(name)
