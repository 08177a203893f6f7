"""Renders a model with this package and with a public rasterizer, and prints how they differ.

    python peer_worker.py inria|dr_aa|gsplat MODEL.npz VIEWS

test_cuda_peers.py runs it, as a process of its own because peers share one module name. The model is one that
benchmarks/timing/models.py reads; how a peer is called is in gpu_renderers.py there. The last line of the output is
JSON, a row for each view.
"""
from __future__ import annotations

import json
import os
import sys

import torch

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [HERE, os.path.join(HERE, "..", "..", "..", "benchmarks", "timing")]
import gpu_renderers  # noqa: E402
import models  # noqa: E402
from flips import explain  # noqa: E402

from diff_smoe_rasterization import rasterize  # noqa: E402

COLOR_TOLERANCE = 2e-5
GATED_TOLERANCE = 1e-4  # of a colour divided by gsplat's alpha, 1 - T, which cancellation leaves 6e-8 / ALPHA_LEAST
ALPHA_LEAST = 0.05
JACOBIAN_MARGIN = 1.3  # tan(fov / 2) beyond which the projection's Jacobian is clamped


def relative(actual, expected):
    return ((actual.double() - expected.double()).norm() / expected.double().norm()).item()


def jacobian_is_clamped(means3D, settings):
    """[N] bool. There Inria's backward is not the derivative of its forward, and gsplat's is another."""
    view = means3D.detach() @ settings.viewmatrix[:3, :3] + settings.viewmatrix[3, :3]
    x, y = (view[:, axis] / view[:, 2] for axis in (0, 1))
    return (x.abs() > 0.999 * JACOBIAN_MARGIN * settings.tanfovx) | (
        y.abs() > 0.999 * JACOBIAN_MARGIN * settings.tanfovy)


def image_gradient(left_out):
    """Fixed random numbers [3, H, W], 0 if `left_out` is set."""
    generator = torch.Generator(device="cpu").manual_seed(0)
    return torch.randn(3, *left_out.shape, generator=generator).to(left_out.device) * ~left_out


def gradient_differences(actual, expected, settings, means3D):
    """Relative errors by name; the gradients of the means without Gaussians whose Jacobian is clamped."""
    kept = ~jacobian_is_clamped(means3D, settings)
    return {name: relative(values[kept] if name == "means3D" else values,
                           expected[name][kept] if name == "means3D" else expected[name])
            for name, values in actual.items()}


def leaves_of(inputs):
    leaves = {name: tensor.detach().clone().requires_grad_() for name, tensor in inputs.items()}
    leaves["means2D"] = torch.zeros_like(leaves["means3D"]).requires_grad_()
    return leaves


def against_inria(model, view, peer):
    """One view in `alpha` mode; `dr_aa` is antialiased if its renderer says so."""
    settings = model.settings(view, "alpha")
    antialiasing = bool(peer.more_settings.get("antialiasing"))
    settings = settings._replace(antialiasing=antialiasing)
    ours, theirs = leaves_of(model.inputs), leaves_of(model.inputs)
    rendering = rasterize(settings=settings, outputs=("inverse_depth",), **ours)
    results = peer.views[view](**theirs)
    color, radii = results[:2]
    different = ((rendering.color - color).abs() > COLOR_TOLERANCE).any(0)
    difference = (rendering.radii - radii).abs()
    row = {
        "gaussians": model.num_gaussians, "visible": int((radii > 0).sum()), "pixels": different.numel(),
        "radii_different": int((difference > 0).sum()), "radii_largest": int(difference.max()),
        "clamped": int(jacobian_is_clamped(ours["means3D"], settings).sum()),
        **explain(rendering.color, color, different, model.inputs, settings, "alpha"),
        "largest_difference": (rendering.color - color).abs().max().item(),
    }
    if len(results) > 2:
        row["inverse_depth"] = relative(rendering.inverse_depth[:, ~different], results[2][:, ~different])
    dL_dcolor = image_gradient(different)
    rendering.color.backward(dL_dcolor)
    color.backward(dL_dcolor)
    row["gradients"] = gradient_differences({name: leaf.grad for name, leaf in ours.items()},
                                            {name: leaf.grad for name, leaf in theirs.items()}, settings,
                                            ours["means3D"])
    return row


def against_gsplat(model, view, peer):
    """One view in `smoe` mode at alpha_min = 1/255, against gsplat's colour divided by its alpha."""
    settings = model.settings(view, "smoe")._replace(alpha_min=1 / 255)
    ours = {name: tensor.detach().clone().requires_grad_() for name, tensor in model.inputs.items()}
    rendering = rasterize(settings=settings, outputs=("alpha",), **ours)
    p = peer.parameters
    colors, alphas, _ = peer.rasterization(means=p["means3D"], quats=p["rotations"], scales=p["scales"],
                                           opacities=p["opacities"], colors=p["shs"], **peer.views[view])
    alpha = alphas[0].permute(2, 0, 1)
    gated = colors[0].permute(2, 0, 1) / alpha.clamp(min=ALPHA_LEAST)
    compared = alpha[0] > ALPHA_LEAST
    different = ((rendering.color - gated).abs() > GATED_TOLERANCE).any(0) | (
        (rendering.alpha - alpha)[0].abs() > COLOR_TOLERANCE)
    row = {"pixels": int(compared.sum()),
           **explain(torch.cat([rendering.color, rendering.alpha]), torch.cat([gated, alpha]), different & compared,
                     model.inputs, settings, "smoe"),
           "largest_difference": ((rendering.color - gated).abs() * compared).max().item()}
    dL_dcolor = image_gradient(different | ~compared)
    dL_dalpha = dL_dcolor[:1]
    torch.autograd.backward([rendering.color, rendering.alpha], [dL_dcolor, dL_dalpha])
    torch.autograd.backward([gated, alpha], [dL_dcolor, dL_dalpha])
    actual = {name: leaf.grad for name, leaf in ours.items()}
    expected = {name: leaf.grad for name, leaf in p.items()}
    expected["opacities"] = expected["opacities"][:, None]
    # gsplat normalises quaternions, so its gradient has no part along them.
    unit = model.inputs["rotations"]
    actual["rotations"] = actual["rotations"] - (actual["rotations"] * unit).sum(1, keepdim=True) * unit
    row["gradients"] = gradient_differences(actual, expected, settings, ours["means3D"])
    for leaf in p.values():
        leaf.grad = None
    return row


def main(name, path, views):
    sys.path.insert(0, os.path.join(os.environ["DSMOE_PEERS"], name.split("+")[0]))
    model = models.from_npz(path).seen(int(views)).to("cuda")
    if name == "gsplat":
        # Its largest alpha is 0.999, ours 0.99.
        model = model._replace(inputs={**model.inputs, "opacities": model.inputs["opacities"].clamp(max=0.98)})
        peer, compare = gpu_renderers.Gsplat(model), against_gsplat
    else:
        peer_type = {"inria": gpu_renderers.Inria, "dr_aa": gpu_renderers.InriaAntialiasing,
                     "dr_aa+antialiasing": AntialiasedInria}[name]
        peer, compare = peer_type(model), against_inria
    print(json.dumps([compare(model, view, peer) for view in range(len(model.cameras))]))


class AntialiasedInria(gpu_renderers.InriaAntialiasing):
    more_settings = {"antialiasing": True}


if __name__ == "__main__":
    main(*sys.argv[1:])
