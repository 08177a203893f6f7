import torch
from scene.points import Points
from utils.adam import Adam

try:
    from diff_gaussian_rasterization import SparseGaussianAdam
except ImportError:
    pass


class GaussianModel(Points):
    def __init__(self, degree, optimizer_type="default"):
        super().__init__(degree)
        self.kind, self.exposures, self.tmp_radii = optimizer_type, {}, None

    def get_exposure_from_name(self, name):
        return self.exposures.get(name, torch.eye(3, 4, device=self._xyz.device))

    def training_setup(self, rates, names):
        optimizer = SparseGaussianAdam if self.kind == "sparse_adam" else Adam
        self.prepare(rates, lambda groups: optimizer(groups, lr=0.0, eps=1e-15))
        self.exposures = {name: torch.nn.Parameter(torch.eye(3, 4, device=self._xyz.device)) for name in names}
        self.exposure_optimizer = Adam([{"params": list(self.exposures.values())}], rates.exposure_lr_init, 1e-15)

    def densify_and_prune(self, max_grad, min_opacity, extent, largest, radii):
        steepness = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)[:, 0]
        self.tmp_radii = radii
        self.densify_and_clone(steepness >= max_grad, extent)
        self.densify_and_split(steepness >= max_grad, extent)
        self.prune_points(self.superfluous(min_opacity, extent, largest))
        self.tmp_radii = None

    def densify_and_clone(self, steep, extent):
        mask = steep & self.is_small(extent)
        self.densification_postfix(self.rows(mask), self.tmp_radii[mask])

    def densify_and_split(self, steep, extent, N=2):
        mask = ~self.is_small(extent) & self.padded(steep)
        self.densification_postfix(self.thrown_rows(mask, N), self.tmp_radii[mask].repeat(N))
        self.prune_points(self.padded(mask))

    def densification_postfix(self, new, new_radii):
        self.add_rows(new)
        self.tmp_radii = torch.cat([self.tmp_radii, new_radii])
        self.forget_statistics()

    def prune_points(self, superfluous):
        self.keep_rows(~superfluous)
        self.tmp_radii = self.tmp_radii[~superfluous]
        self.keep_statistics(~superfluous)
