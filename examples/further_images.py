"""Depth and coverage beside the colour: python examples/further_images.py model.ply -o FOLDER"""
import argparse
import os

from render_ply import ask_for_camera, check_seen, load, look_at, save

from diff_smoe_rasterization import rasterize

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("model")
ask_for_camera(parser)
parser.add_argument("-o", "--output", default="images")
arguments = parser.parse_args()

gaussians, options = load(arguments.model)
settings = look_at(arguments.eye, arguments.target, **options)
rendering = rasterize(settings=settings, outputs=("alpha", "depth", "inverse_depth"), **gaussians)
check_seen(rendering)

os.makedirs(arguments.output, exist_ok=True)
save(rendering.color, os.path.join(arguments.output, "color.png"))
save(rendering.alpha, os.path.join(arguments.output, "alpha.png"))  # the gate sum: 1 where Gaussians cover
save(rendering.depth / rendering.depth.max(), os.path.join(arguments.output, "depth.png"))  # far is bright; 0: nothing
save(rendering.inverse_depth / rendering.inverse_depth.max(), os.path.join(arguments.output, "inverse_depth.png"))
visible = rendering.radii > 0
print(f"{int(visible.sum())} of {len(visible)} Gaussians are seen; expected depth from "
      f"{rendering.depth[rendering.depth > 0].min():.2f} to {rendering.depth.max():.2f}")
