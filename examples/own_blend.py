"""A blend mode of one's own, tried in plain torch before it is written in C++: python examples/own_blend.py

The reference is made of stages, and only the last one knows the blend. Here it is a sharpened gate, with a power p that
is learned: C = sum c_i w_i^p / sum w_i^p, w_i = alpha_i T_i. At p = 1 that is Eq. 7. Two round Gaussians fit a sharp
edge between two colours. DEVELOPING.md says how a mode becomes part of the core.
"""
import argparse

import torch
from render_ply import save

from diff_smoe_rasterization import reference, settings_from_camera


def render(settings, power, means3D, opacities, colors, scales, rotations):
    """[3, H, W]: projection and pairs by the reference, blended by the sharpened gate."""
    unused = torch.zeros_like(means3D)  # means2D
    gaussians = reference.Gaussians(means3D, unused, opacities, None, colors, scales, rotations, None)
    _, order = reference.visible(gaussians, settings, "smoe_eq7")
    splats = reference.project(reference.Gaussians(*(t if t is None else t[order] for t in gaussians)), settings)
    height, width = settings.image_height, settings.image_width
    x = torch.arange(width).float().repeat(height)
    y = torch.arange(height).float().repeat_interleave(width)
    counts = reference.pair_counts(splats, x, y, settings, "smoe_eq7", gate=0.0)
    alpha = reference.pair_alphas(splats, x, y, counts)  # [n, pixels], nearest first
    weight, _ = reference.numerator(alpha, "smoe_eq7")  # alpha T
    gate = (weight + 1e-12) ** power
    return ((splats.color.T @ gate) / gate.sum(0)).view(3, height, width)


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=80)
parser.add_argument("-o", "--output", default="edge.png")
arguments = parser.parse_args()

width, height = 48, 32
K = [[40.0, 0, width / 2], [0, 40.0, height / 2], [0, 0, 1]]
settings = settings_from_camera(K, torch.eye(3), torch.zeros(3), width, height)
target = torch.zeros(3, height, width)
target[0, :, :width // 2], target[2, :, width // 2:] = 1, 1  # red and blue

power = torch.ones(1, requires_grad=True)
means3D = torch.tensor([[-0.4, 0.0, 2.0], [0.35, 0.05, 2.0]], requires_grad=True)
colors = torch.tensor([[0.8, 0.2, 0.2], [0.2, 0.2, 0.8]], requires_grad=True)
fixed = {"opacities": torch.full((2,), 0.5), "scales": torch.full((2, 3), 0.5),
         "rotations": torch.tensor([[1.0, 0, 0, 0]] * 2)}
adam = torch.optim.Adam([{"params": [means3D, colors], "lr": 0.02}, {"params": [power], "lr": 0.2}])
for step in range(arguments.steps):
    image = render(settings, power, means3D, colors=colors, **fixed)
    loss = (image - target).square().mean()
    adam.zero_grad()
    loss.backward()
    adam.step()
    if step % 20 == 0 or step == arguments.steps - 1:
        print(f"step {step}: {-10 * loss.log10().item():.1f} dB with the power {power.item():.2f}")
save(image, arguments.output)
