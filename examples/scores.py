"""Drops the Gaussians that change images least: python examples/scores.py model.ply -o smaller.ply"""
import argparse
import dataclasses
import math

import torch
from render_ply import load, look_at

from diff_smoe_rasterization import io, rasterize, rasterize_with_splats

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("model")
parser.add_argument("--keep", type=float, default=0.5, help="part of the Gaussians that is kept")
parser.add_argument("-o", "--output", default="smaller.ply")
arguments = parser.parse_args()

gaussians, options = load(arguments.model)
views = [look_at((2.7 * math.cos(angle), 1.6, 2.7 * math.sin(angle)), (0.0, 0.6, 0.0), **options)
         for angle in torch.arange(8) * math.pi / 4]

# A Gaussian's score: the squared change of all views if it were not there.
score, images = torch.zeros(len(gaussians["means3D"])), []
with torch.no_grad():
    for settings in views:
        rendering, splats = rasterize_with_splats(settings=settings, **gaussians)
        score += splats.importance().removal_costs
        images.append(rendering.color)


def change(rows):
    """PSNR in dB of the views with these Gaussians only, against those with all."""
    with torch.no_grad():
        errors = [(rasterize(settings=settings, **{name: tensor[rows] for name, tensor in gaussians.items()}).color
                   - image).square().mean() for settings, image in zip(views, images)]
    return -10 * torch.stack(errors).mean().log10().item()


order = score.argsort(descending=True)
kept = int(arguments.keep * len(order))
print(f"{len(order)} Gaussians to {kept}: {change(order[:kept]):.1f} dB with the best, "
      f"{change(torch.randperm(len(order))[:kept]):.1f} dB with any")
rows, stored = order[:kept].numpy(), io.read_gaussians(arguments.model)
arrays = {field.name: getattr(stored, field.name)[rows] for field in dataclasses.fields(stored)
          if hasattr(getattr(stored, field.name), "shape")}
io.write_gaussians(arguments.output, dataclasses.replace(stored, **arrays))
