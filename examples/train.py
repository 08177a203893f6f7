"""Trains Gaussians on a scene, without densification: python examples/train.py -o model.ply [--scene SCENE]

Without a scene it makes a small one. `dsmoe train` has the whole recipe.
"""
import argparse
import tempfile

import torch

from diff_smoe_rasterization import FusedAdam, distCUDA2, io, rasterize
from diff_smoe_rasterization.losses import l1_ssim_loss
from dsmoe.options.config import TrainConfig
from dsmoe.scenes.scene import load_scene
from dsmoe.scenes.synthetic import write_synthetic_scene

RATES = {"means3D": 5e-4, "dc": 0.01, "opacities": 0.05, "scales": 0.01, "rotations": 0.002}  # of Adam, as in 3DGS

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--scene", help="folder of a scene, as dsmoe train takes it")
parser.add_argument("--blend-mode", default="smoe", choices=["alpha", "smoe"])
parser.add_argument("--iterations", type=int, default=300)
parser.add_argument("-o", "--output", default="model.ply")
arguments = parser.parse_args()

torch.manual_seed(0)
with tempfile.TemporaryDirectory() as folder:
    if not arguments.scene:
        write_synthetic_scene(folder, views=12, width=80, height=60, points=1200)
    scene = load_scene(TrainConfig(scene=arguments.scene or folder, blend_mode=arguments.blend_mode), progress=False)

# What Adam moves: colours as harmonics of degree 0, logits of opacities, logarithms of scales.
count, positions = len(scene.points.positions), torch.tensor(scene.points.positions).float()
widths = distCUDA2(positions).clamp(min=1e-7).sqrt()[:, None].expand(count, 3)
raw = {"means3D": positions, "dc": (torch.tensor(scene.points.colors).float()[:, None] - 0.5) / 0.28209479,
       "opacities": torch.full((count, 1), -2.0), "scales": widths.log(),
       "rotations": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)}
raw = {name: tensor.clone().requires_grad_() for name, tensor in raw.items()}
adam = FusedAdam([{"params": [tensor], "lr": RATES[name]} for name, tensor in raw.items()], eps=1e-15)
gate = 0.0 if arguments.blend_mode == "smoe" else None

for step in range(arguments.iterations):
    view = scene.train[torch.randint(len(scene.train), (1,)).item()]
    settings = view.camera.settings(torch.zeros(3), sh_degree=0, blend_mode=arguments.blend_mode)
    rendering = rasterize(raw["means3D"], raw["opacities"].sigmoid(), settings._replace(background_gate=gate),
                          shs=raw["dc"], scales=raw["scales"].exp(),
                          rotations=torch.nn.functional.normalize(raw["rotations"]))
    loss = l1_ssim_loss(rendering.color, view.image_float())
    loss.backward()
    adam.step()
    adam.zero_grad(set_to_none=True)
    if step % 50 == 0 or step == arguments.iterations - 1:
        print(f"step {step}: loss {loss.item():.4f}")

arrays = {name: tensor.detach().numpy() for name, tensor in raw.items()}
io.write_gaussians(arguments.output, io.Gaussians(
    arrays["means3D"], arrays["dc"], arrays["dc"][:, :0], arrays["opacities"], arrays["scales"], arrays["rotations"],
    blend_mode=arguments.blend_mode, background_gate=gate))
print(f"{arguments.output}: {count} Gaussians")
