import torch
from simple_knn._C import distCUDA2
from torch import nn
from utils.general_utils import build_covariance, build_rotation, get_expon_lr_func, inverse_sigmoid
from utils.graphics_utils import Cloud
from utils.growing import GrowingTensors
from utils.sh_utils import RGB2SH


class Points(GrowingTensors):
    """Gaussians with an opacity, a shape and spherical harmonics each, and what densification counts of them."""

    FIELDS = {"xyz": "_xyz", "f_dc": "_features_dc", "f_rest": "_features_rest", "opacity": "_opacity",
              "scaling": "_scaling", "rotation": "_rotation"}

    def __init__(self, sh_degree):
        self.active_sh_degree, self.full_sh_degree = 0, sh_degree

    get_xyz = property(lambda self: self._xyz)
    get_features = property(lambda self: torch.cat([self._features_dc, self._features_rest], dim=1))
    get_features_dc = property(lambda self: self._features_dc)
    get_features_rest = property(lambda self: self._features_rest)
    get_opacity = property(lambda self: self._opacity.sigmoid())
    get_scaling = property(lambda self: self._scaling.exp())
    get_rotation = property(lambda self: nn.functional.normalize(self._rotation))

    def get_covariance(self, scaling_modifier=1.0):
        return build_covariance(scaling_modifier * self.get_scaling, self._rotation)

    def oneupSHdegree(self):
        self.active_sh_degree = min(self.active_sh_degree + 1, self.full_sh_degree)

    def load(self, path, data_device):
        super().load(path, data_device)
        self.active_sh_degree = self.full_sh_degree

    def create_from_pcd(self, pcd: Cloud, spatial_lr_scale, data_device):
        points = torch.tensor(pcd.points, device=data_device)
        count = len(points)
        rest = (self.full_sh_degree + 1) ** 2 - 1
        quaternions = torch.zeros(count, 4, device=data_device)
        quaternions[:, 0] = 1
        scales = distCUDA2(points).clamp_min(1e-7).sqrt().log()
        start = {"xyz": points, "f_dc": RGB2SH(torch.tensor(pcd.colors, device=data_device))[:, None],
                 "f_rest": torch.zeros(count, rest, 3, device=data_device),
                 "opacity": inverse_sigmoid(torch.full((count, 1), 0.1, device=data_device)),
                 "scaling": scales[:, None].repeat(1, 3), "rotation": quaternions}
        for name, field in self.FIELDS.items():
            setattr(self, field, nn.Parameter(start[name]))

    def prepare(self, opt, make_optimizer):
        """make_optimizer: from parameter groups to an optimizer."""
        rates = {"xyz": opt.position_lr_init, "f_dc": opt.feature_lr, "f_rest": opt.feature_lr / 20,
                 "opacity": opt.opacity_lr, "scaling": opt.scaling_lr, "rotation": opt.rotation_lr}
        self.percent_dense = opt.percent_dense
        self.optimizer = make_optimizer([{"params": [getattr(self, field)], "lr": rates[name], "name": name}
                                         for name, field in self.FIELDS.items()])
        self.optimizers = (self.optimizer,)
        self.xyz_rate = get_expon_lr_func(opt.position_lr_init, opt.position_lr_final, opt.iterations)
        self.forget_statistics()

    def update_learning_rate(self, step):
        self.optimizer.param_groups[0]["lr"] = self.xyz_rate(step)

    def reset_opacity(self):
        lowered = inverse_sigmoid(self.get_opacity.clamp_max(0.2)).detach()
        self.rebuild(lambda name, tensor: lowered if name == "opacity" else tensor, lambda moment, rows: moment)

    def forget_statistics(self):
        self.xyz_gradient_accum = torch.zeros_like(self._opacity)
        self.denom = torch.zeros_like(self._opacity)
        self.max_radii2D = torch.zeros_like(self._opacity[:, 0])

    def keep_statistics(self, mask):
        for name in ("xyz_gradient_accum", "denom", "max_radii2D"):
            setattr(self, name, getattr(self, name)[mask])

    def add_densification_stats(self, screen_points, seen):
        self.xyz_gradient_accum[seen] += screen_points.grad[:, :2].norm(dim=-1, keepdim=True)[seen]
        self.denom[seen] += torch.ones_like(self.denom[seen])

    def rows(self, mask):
        return {name: getattr(self, field).detach()[mask] for name, field in self.FIELDS.items()}

    def padded(self, mask):
        """mask, and False for the Gaussians that have been added since."""
        return torch.cat([mask, mask.new_zeros(len(self._xyz) - len(mask))])

    def is_small(self, extent):
        return self.get_scaling.amax(dim=1) <= self.percent_dense * extent

    def thrown_rows(self, mask, N):
        """N smaller Gaussians for each of mask, thrown as their Gaussian says."""
        scales = self.get_scaling.detach()[mask].repeat(N, 1)
        turned = build_rotation(self._rotation.detach()[mask]).repeat(N, 1, 1)
        new = {name: rows.repeat(N, *[1] * (rows.dim() - 1)) for name, rows in self.rows(mask).items()}
        new["xyz"] = new["xyz"] + (turned @ (torch.randn_like(scales) * scales)[..., None])[..., 0]
        new["scaling"] = (scales / (0.8 * N)).log()
        return new

    def superfluous(self, min_opacity, extent, largest):
        """What pruning takes: too transparent, or, where `largest` pixels are allowed, too large."""
        mask = self.get_opacity[:, 0] < min_opacity
        if largest is not None:
            mask |= (self.max_radii2D > largest) | (self.get_scaling.amax(dim=1) > 0.1 * extent)
        return mask
