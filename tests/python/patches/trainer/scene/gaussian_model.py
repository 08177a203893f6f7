import numpy as np
import torch
from simple_knn._C import distCUDA2
from torch import nn
from utils.general_utils import Adam


class GaussianModel:
    """Gaussians that are cloned where the loss is steep, and go where they are transparent."""

    FIELDS = {"xyz": "_xyz", "f_dc": "_features_dc", "f_rest": "_features_rest", "opacity": "_opacity",
              "scaling": "_scaling", "rotation": "_rotation"}

    def __init__(self, degree):
        self.active_sh_degree, self.max_sh_degree = 0, degree

    get_xyz = property(lambda self: self._xyz)
    get_features = property(lambda self: torch.cat([self._features_dc, self._features_rest], dim=1))
    get_opacity = property(lambda self: self._opacity.sigmoid())
    get_scaling = property(lambda self: self._scaling.exp())
    get_rotation = property(lambda self: nn.functional.normalize(self._rotation))

    def oneupSHdegree(self):
        self.active_sh_degree = min(self.active_sh_degree + 1, self.max_sh_degree)

    def set_rows(self, rows):
        for name, field in self.FIELDS.items():
            setattr(self, field, nn.Parameter(rows[name]))

    def rows(self):
        return {name: getattr(self, field).detach() for name, field in self.FIELDS.items()}

    def create_from_pcd(self, points, colors, data_device):
        xyz = torch.tensor(points, device=data_device)
        quaternions = torch.zeros(len(xyz), 4, device=data_device)
        quaternions[:, 0] = 1
        self.set_rows({
            "xyz": xyz, "f_dc": (torch.tensor(colors, device=data_device)[:, None] - 0.5) / 0.28209479177387814,
            "f_rest": xyz.new_zeros(len(xyz), (self.max_sh_degree + 1) ** 2 - 1, 3),
            "opacity": torch.logit(xyz.new_full((len(xyz), 1), 0.1)), "rotation": quaternions,
            "scaling": distCUDA2(xyz).clamp_min(1e-7).sqrt().log()[:, None].repeat(1, 3)})

    def training_setup(self, opt):
        self.opt = opt
        rates = {"xyz": opt.position_lr_init, "f_dc": opt.feature_lr, "f_rest": opt.feature_lr / 20,
                 "opacity": opt.opacity_lr, "scaling": opt.scaling_lr, "rotation": opt.scaling_lr}
        self.optimizer = Adam([{"params": [getattr(self, field)], "lr": rates[name]}
                               for name, field in self.FIELDS.items()], lr=0.0, eps=1e-15)

    def densify_and_prune(self, screen_points, threshold):
        """Moments of Adam begin anew."""
        steep = screen_points.grad[:, :2].norm(dim=1) >= threshold
        kept = self.get_opacity.detach()[:, 0] > 0.09
        self.set_rows({name: torch.cat([rows[kept], rows[steep & kept]]) for name, rows in self.rows().items()})
        self.training_setup(self.opt)

    def save(self, path):
        np.savez(path, **{name: rows.cpu().numpy() for name, rows in self.rows().items()})

    def load(self, path, data_device):
        with np.load(path) as saved:
            self.set_rows({name: torch.tensor(saved[name], device=data_device) for name in self.FIELDS})
        self.active_sh_degree = self.max_sh_degree
