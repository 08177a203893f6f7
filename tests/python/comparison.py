"""How the tests compare tensors, and where a comparison in float32 makes sense."""
from __future__ import annotations

import contextlib
import math

import torch
from devices import on_the_cpu
from scenes import gradients

from diff_smoe_rasterization import reference
from diff_smoe_rasterization.settings import leaves_out_faint, resolve_faint_below


@contextlib.contextmanager
def one_thread():
    """For the reference on small tensors, on which more threads of torch only wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def relative_error(actual, expected):
    """Returns |actual - expected| / |expected| in the 2-norm, computed in float64."""
    actual, expected = actual.detach().double(), expected.detach().double()
    return ((actual - expected).norm() / expected.norm()).item()


def assert_close(actual, expected, tolerance, name):
    """Compares by the norm of the difference relative to the norm; what must be zero must be exactly zero.

    The two may be of different types and on different devices.
    """
    actual = actual.to(expected.device)
    assert actual.shape == expected.shape, f"{name}: shape {tuple(actual.shape)}, not {tuple(expected.shape)}"
    assert torch.isfinite(actual).all(), f"{name} is not finite"
    if not expected.any():
        assert not actual.any(), f"{name} must be exactly zero, its largest value is {actual.abs().max():.3g}"
        return
    error = relative_error(actual, expected)
    assert error <= tolerance, f"{name}: relative error {error:.3g}, allowed {tolerance:.3g}"


def assert_all_close(actual, expected, tolerance):
    """Compares two dictionaries of tensors."""
    assert actual.keys() == expected.keys()
    for name in expected:
        assert_close(actual[name], expected[name], tolerance, name)


def assert_same_gradients(actual, expected, tolerance=1e-5):
    """Compares the gradients of equal calls, two dictionaries of tensors: on the CPU no bit may differ.

    A GPU adds a Gaussian's terms in the order in which its tiles are done, which is another one each time.
    """
    assert actual.keys() == expected.keys()
    for name, values in expected.items():
        if values.device.type == "cpu":
            assert torch.equal(actual[name], values), name
        else:
            # Some thousand terms that cancel in part: roundings of 6e-8 or of 1e-16 each.
            assert_close(actual[name], values, tolerance if values.dtype == torch.float32 else 1e-12, name)


def assert_is_the_references(rendering, actual, expected_rendering, expected, tolerance):
    """Compares image, radii and gradients with what `reference_gradients` returns of 60 Gaussians, a part of them seen.

    The gradient of means2D is among them: dL/d(pixel) times half the image's size.
    """
    assert_close(rendering.color, expected_rendering.color, tolerance, "color")
    assert torch.equal(rendering.radii.cpu(), expected_rendering.radii)
    assert (rendering.radii > 0).sum() > 20 and (rendering.radii == 0).sum() > 5
    assert expected["means2D"][:, :2].any() and not actual["means2D"][:, 2].any()
    assert_all_close(actual, expected, tolerance)


def reference_contributions(scene, pixel_weights):
    """Returns centres, depths and contributions, of the reference and on the CPU."""
    scene = scene.to("cpu")
    inputs = {name: tensor for name, tensor in scene.inputs.items() if name != "means2D"}
    with one_thread(), on_the_cpu():
        return reference.contributions(settings=scene.settings, pixel_weights=pixel_weights.cpu(), **inputs)


def reference_gradients(scene, outputs=(), camera=True):
    """Returns (rendering, gradients by name) as scenes.gradients, of the reference and on the CPU."""
    with one_thread(), on_the_cpu():
        return gradients(reference.rasterize, scene.to("cpu"), outputs, camera)


def threshold_margin(scene):
    """Returns how near each pixel is to another outcome [H, W], CPU: the least |ln(value / threshold)| over its pairs.

    Thresholds are the cut-offs on G and on alpha and the early stop. In float32, and under finite differences, a pixel
    with a margin within the error of its values may fall on the other side. For small scenes: it is dense.
    """
    scene = scene.to("cpu").to(torch.float64)
    settings, (mode, gate) = scene.settings, reference.mode_and_gate(scene.settings)
    with torch.no_grad(), on_the_cpu():
        gaussians = reference._gather(*(scene.inputs.get(name) for name in (
            "means3D", "means2D", "opacities", "dc", "shs", "colors_precomp", "scales", "rotations", "cov3D_precomp")))
        order = reference.visible(gaussians, settings, mode)[1]
        splats = reference.project(reference._rows(gaussians, order), settings)
        y, x = (axis.reshape(-1).double() for axis in torch.meshgrid(
            torch.arange(settings.image_height), torch.arange(settings.image_width), indexing="ij"))
        power = reference._power(splats.conic, splats.position[:, :1] - x, splats.position[:, 1:] - y)
        log_alpha = power + splats.opacity.clamp(min=1e-300).log()[:, None]
        if mode == "alpha":
            distances = [log_alpha - math.log(reference.ALPHA_MIN)]
        elif mode == "smoe":
            distances = [log_alpha - math.log(max(reference.STRONG_MIN, settings.alpha_min))]
        else:
            distances = [power - math.log(reference.KERNEL_MIN)]
            if settings.alpha_min > 0:
                distances.append(log_alpha - math.log(settings.alpha_min))
            if gate > 0:
                # If the opacity is so small that 3 sigma count, the cut is only on G.
                cut = math.log(float(gate) * reference.ALPHA_MIN)
                distances.append(torch.maximum(log_alpha - cut, power - math.log(reference.KERNEL_KEPT)))
        counts = reference.pair_counts(splats, x, y, settings, mode, gate)
        if mode != "smoe_std":
            alpha = reference.pair_alphas(splats, x, y, counts)
            distances.append(torch.log1p(-alpha).cumsum(0) - math.log(reference.TRANSMITTANCE_MIN))
        if leaves_out_faint(mode, settings.faint_below):
            # A pair is near by its alpha, or by its kernel and a lower alpha. Near pairs stop early by themselves.
            # They decide in the pixels that they cover, and in others if one pair more, of 1/255, could cover them.
            near = reference.pair_alphas(splats, x, y, reference.near_pairs(splats, x, y, counts))
            in_core = torch.minimum(power - math.log(reference.KERNEL_KEPT), log_alpha - math.log(reference.CORE_MIN))
            by_near = [torch.maximum(log_alpha - math.log(reference.ALPHA_MIN), in_core),
                       torch.log1p(-near).cumsum(0) - math.log(reference.TRANSMITTANCE_MIN)]
            below = resolve_faint_below(mode, settings.faint_below)
            weight = reference.numerator(near, mode)[0].sum(0, keepdim=True)
            wide = weight < below
            distances = [distance.masked_fill(~wide, math.inf) for distance in distances]
            distances += [distance.masked_fill(wide & (weight < 0.98 * below), math.inf) for distance in by_near]
            if below > 0:
                distances.append(weight.clamp(min=1e-300).log() - math.log(below))
        nearest = torch.cat([torch.full_like(x, math.inf)[None]] + [distance.abs() for distance in distances]).min(0)[0]
    return nearest.reshape(settings.image_height, settings.image_width)
