"""Renders a .ply as it was trained: python examples/render_ply.py model.ply -o image.png"""
import argparse

import numpy as np
import torch
from PIL import Image

from diff_smoe_rasterization import io, rasterize, settings_from_camera


def load(path):
    """The Gaussians of a .ply as arguments of `rasterize`, and the blend that the file records."""
    stored = io.read_gaussians(path)
    arguments = {
        "means3D": torch.tensor(stored.means3D),
        "opacities": torch.tensor(stored.opacity_logits).sigmoid(),
        "scales": torch.tensor(stored.log_scales).exp(),
        "rotations": torch.nn.functional.normalize(torch.tensor(stored.rotations)),
        "shs": torch.tensor(np.concatenate([stored.dc, stored.shs], axis=1)),
    }
    blend = {"blend_mode": stored.blend_mode or "alpha", "background_gate": stored.background_gate}
    faint = [comment.split()[1] for comment in stored.comments if comment.startswith("faint_below ")]
    if faint:  # not the mode's usual one
        blend["faint_below"] = float(faint[0])
    return arguments, {**blend, "sh_degree": stored.sh_degree}


def look_at(eye, target, width=400, height=300, up=(0.0, 1.0, 0.0), focal=400, **options):
    """Settings of a camera at `eye` that sees `target` in its centre; options: further settings.

    focal: pixels; None for a lens that has no focal length.
    """
    eye, target, up = (torch.tensor(value, dtype=torch.float64) for value in (eye, target, up))
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])  # x right, y down, z forward
    K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]] if focal else None
    return settings_from_camera(K, rotation, -rotation @ eye, width, height, **options)


def save(image, path):
    """Writes an image [3, H, W] or [1, H, W] in [0, 1]."""
    values = (image.detach().expand(3, -1, -1).clamp(0, 1) * 255).round().byte()
    Image.fromarray(values.permute(1, 2, 0).contiguous().numpy()).save(path)


def ask_for_camera(parser):
    """Offers a camera, which by default sees the room of train.py."""
    parser.add_argument("--eye", type=float, nargs=3, default=[2.7, 1.6, 0.3], help="where the camera is")
    parser.add_argument("--target", type=float, nargs=3, default=[0.0, 0.6, 0.0], help="what it looks at")


def check_seen(rendering):
    """Ends the program if the image is empty."""
    if not (rendering.radii > 0).any():
        raise SystemExit("no Gaussian is seen from there; --eye X Y Z and --target X Y Z say another camera")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", help="a .ply of 3DGS, or of this trainer")
    ask_for_camera(parser)
    parser.add_argument("-o", "--output", default="image.png")
    arguments = parser.parse_args()
    gaussians, options = load(arguments.model)
    rendering = rasterize(settings=look_at(arguments.eye, arguments.target, **options), **gaussians)
    check_seen(rendering)
    save(rendering.color, arguments.output)
