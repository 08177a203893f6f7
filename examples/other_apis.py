"""The same Gaussians by two other rasterizers' APIs, Inria's of 2023 and gsplat's: python examples/other_apis.py"""
import math

import torch

from diff_smoe_rasterization.integrations.gsplat import rasterization
from diff_smoe_rasterization.integrations.inria import GaussianRasterizationSettings, GaussianRasterizer

torch.manual_seed(0)
N, W, H = 500, 64, 48
means = torch.randn(N, 3) * 0.5
scales, rotations = torch.full((N, 3), 0.05), torch.nn.functional.normalize(torch.randn(N, 4), dim=1)
opacities, shs = torch.rand(N, 1), 0.3 * torch.randn(N, 16, 3)
tan = math.tan(0.4)
view = torch.eye(4)
view[3, 2] = 4.0  # transposed, as 3DGS has it: the camera stands 4 in front of the cloud
projection = torch.tensor([[1 / tan, 0, 0, 0], [0, W / (H * tan), 0, 0], [0, 0, 1, 1], [0, 0, -0.01, 0]])
camera = dict(image_height=H, image_width=W, tanfovx=tan, tanfovy=tan * H / W, bg=torch.zeros(3), scale_modifier=1.0,
              viewmatrix=view, projmatrix=view @ projection, sh_degree=3, campos=torch.tensor([0.0, 0.0, -4.0]),
              prefiltered=False, debug=False)

rasterizer = GaussianRasterizer(GaussianRasterizationSettings(**camera, blend_mode="smoe"))
color, radii = rasterizer(means3D=means, means2D=torch.zeros_like(means), opacities=opacities, shs=shs,
                          scales=scales, rotations=rotations)

viewmats = torch.stack([view.T, view.T])
focal_length = W / (2 * tan)
Ks = torch.tensor([[focal_length, 0, W / 2], [0, focal_length, H / 2], [0, 0, 1]]).expand(2, 3, 3)
renders, alphas, meta = rasterization(means, rotations, scales, opacities[:, 0], shs, viewmats, Ks, W, H, sh_degree=3,
                                      render_mode="RGB+ED", blend_mode="smoe")

difference = (renders[0, ..., :3].permute(2, 0, 1) - color).abs()
print(f"{int((radii > 0).sum())} of {N} Gaussians are seen; the two images differ by {difference.mean():.1e} on "
      "average")
