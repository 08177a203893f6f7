import torch
from scene.points import Points
from utils.adam import Adam

try:
    from diff_gaussian_rasterization import SparseGaussianAdam
except ImportError:
    pass


class GaussianModel(Points):
    def __init__(self, degree, optimizer_type="default", rendering_mode="sigmoid"):
        super().__init__(degree)
        self.kind, self.mode, self.tmp_radii = optimizer_type, rendering_mode, None

    @property
    def get_opacity(self):
        return self._opacity.abs() if self.mode == "abs" else self._opacity.sigmoid()

    def release_opacities(self):
        """From here on they are unbounded; they keep their values."""
        released = self.get_opacity.detach()
        self.mode = "abs"
        self.rebuild(lambda name, tensor: released if name == "opacity" else tensor, lambda moment, rows: moment)

    def training_setup(self, rates):
        if self.kind == "sparse_adam":
            self.prepare(rates, lambda groups: SparseGaussianAdam(groups, lr=0.0, eps=1e-15))
            return
        self.prepare(rates, lambda groups: Adam([group for group in groups if group["name"] != "f_rest"], 0.0, 1e-15))
        self.shoptimizer = Adam([{"params": [self._features_rest], "lr": rates.shfeature_lr / 20, "name": "f_rest"}],
                                0.0, 1e-15)
        self.optimizers = (self.optimizer, self.shoptimizer)

    def densify_with_score(self, scores, max_screen_size, min_opacity, extent, budget, radii, iter_num):
        steepness = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)[:, 0]
        steep, small = (steepness >= 0.0001) & (scores > 0), self.is_small(extent)
        clones, splits = int((steep & small).sum()), int((steep & ~small).sum())
        room = max(0, min(budget - len(small), clones + splits))
        share = clones * room // max(clones + splits, 1)

        self.tmp_radii = radii
        self.densify_and_clone_taming(scores, share, steep & small)
        self.densify_and_split_taming(scores, min(room - share, splits), steep & ~small)
        self.prune_points(self.superfluous(min_opacity, extent, max_screen_size))
        self.tmp_radii = None

    @staticmethod
    def drawn(scores, number, candidates):
        """A mask of `number` of the candidates, drawn by their scores."""
        mask = torch.zeros_like(candidates)
        if number > 0:
            mask[torch.multinomial(scores * candidates, number)] = True
        return mask

    def densify_and_clone_taming(self, scores, number, candidates):
        mask = self.drawn(scores, number, candidates)
        self.densification_postfix(self.rows(mask), self.tmp_radii[mask])

    def densify_and_split_taming(self, scores, number, candidates, N=2):
        mask = self.padded(self.drawn(scores, number, candidates))
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
