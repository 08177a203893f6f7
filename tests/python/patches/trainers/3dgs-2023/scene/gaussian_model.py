from scene.points import Points
from utils.adam import Adam


class GaussianModel(Points):
    def training_setup(self, rates):
        self.prepare(rates, lambda groups: Adam(groups, lr=0.0, eps=1e-15))

    def densify_and_prune(self, max_grad, min_opacity, extent, largest):
        steepness = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)[:, 0]
        self.densify_and_clone(steepness >= max_grad, extent)
        self.densify_and_split(steepness >= max_grad, extent)
        self.prune_points(self.superfluous(min_opacity, extent, largest))

    def densify_and_clone(self, steep, extent):
        self.densification_postfix(self.rows(steep & self.is_small(extent)))

    def densify_and_split(self, steep, extent, N=2):
        mask = ~self.is_small(extent) & self.padded(steep)
        self.densification_postfix(self.thrown_rows(mask, N))
        self.prune_points(self.padded(mask))

    def densification_postfix(self, new):
        self.add_rows(new)
        self.forget_statistics()

    def prune_points(self, superfluous):
        self.keep_rows(~superfluous)
        self.keep_statistics(~superfluous)
