"""A .ply through five lenses, from one place: python examples/lenses.py model.ply -o lenses.jpg"""
import argparse
import math

import torch
from PIL import Image, ImageDraw
from render_ply import ask_for_camera, load, look_at

from diff_smoe_rasterization import rasterize

SIZE, GAP, BORDER = 260, 8, 22  # pixels: of a square panel, between panels, above a panel for its text
LOW = 3 * SIZE // 4
BONSAI = {"eye": (-2.0, 0.98, -0.4), "target": (0.4, 1.52, 1.68), "up": (0.02, -0.754, -0.656)}
ROWS = (("pinhole", "orthographic", "opencv"), ("fisheye", "equirectangular"))


def lens(name, distance):
    """Width and height of its panel, its focal length in pixels, and its further settings.

    distance: from the camera to what it looks at, which `orthographic` shows in the size that `pinhole` does.
    """
    focal = 0.7 * SIZE
    if name == "orthographic":  # pixels by unit of length
        return SIZE, LOW, focal / distance, {}
    if name == "opencv":  # an action camera, whose corners are 62 degrees off its axis
        return SIZE, LOW, 0.55 * SIZE, {"distortion": (-0.25, 0.04, 0.0, 0.0)}
    if name == "fisheye":  # 190 degrees across
        return SIZE, SIZE, SIZE / math.radians(190), {"distortion": (0.0, 0.0, 0.0, 0.0)}
    return (2 * SIZE + GAP, SIZE, None, {}) if name == "equirectangular" else (SIZE, LOW, focal, {})


def seen(gaussians, options, name, place):
    """[3, H, W]: the Gaussians through a lens. place: `eye`, `target` and `up` of `look_at`."""
    width, height, focal, further = lens(name, math.dist(place["eye"], place["target"]))
    settings = look_at(**place, width=width, height=height, focal=focal, camera_model=name, **further, **options)
    with torch.no_grad():
        return rasterize(settings=settings, **gaussians).color


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("model", help="a .ply of 3DGS, or of this trainer")
ask_for_camera(parser)
parser.add_argument("--up", type=float, nargs=3, default=[0.0, 1.0, 0.0], help="what is up in its images")
parser.add_argument("--bonsai", action="store_true", help="of a model of bonsai: the place of the picture in docs/")
parser.add_argument("-o", "--output", default="lenses.jpg")
arguments = parser.parse_args()

gaussians, options = load(arguments.model)
place = BONSAI if arguments.bonsai else {"eye": arguments.eye, "target": arguments.target, "up": arguments.up}
sheet = Image.new("RGB", (3 * SIZE + 2 * GAP, LOW + SIZE + 2 * BORDER), "white")
draw, top = ImageDraw.Draw(sheet), 0
for names in ROWS:
    left = 0
    for name in names:
        image = seen(gaussians, options, name, place)
        panel = Image.fromarray((image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous().numpy())
        draw.text((left, top + 6), name, fill="black")
        sheet.paste(panel, (left, top + BORDER))
        left += panel.width + GAP
    top += BORDER + panel.height
sheet.save(arguments.output, quality=88)
