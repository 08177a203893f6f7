import os

import torch
from simple_knn._C import distCUDA2
from torch import nn
from torch.nn.functional import normalize
from torch_scatter import scatter_max
from utils.adam import Adam
from utils.encodings import Binary
from utils.growing import GrowingTensors


class Anchors(GrowingTensors):
    """Anchors on a grid; small networks make `n_offsets` Gaussians of each."""

    FIELDS = {"anchor": "_anchor", "offset": "_offset", "mask": "_mask", "anchor_feat": "_anchor_feat",
              "scaling": "_scaling", "rotation": "_rotation"}
    mask_columns = 0  # beyond one for each offset

    def __init__(self, params, decoded=False):
        """params: the extracted ModelParams; decoded: whether the features are multiples of a step already."""
        self.decoded, self.voxel_size, self.n_offsets = decoded, params.voxel_size, params.n_offsets
        self.feat_dim = feat_dim = params.feat_dim
        first = params.voxel_size * params.update_init_factor
        self.cell_sizes = [first / params.update_hierarchy_factor ** depth for depth in range(params.update_depth)]

        def network(outputs, *last):
            return nn.Sequential(nn.Linear(feat_dim + 4, feat_dim), nn.ReLU(), nn.Linear(feat_dim, outputs), *last)

        self.networks = {"mlp_opacity": network(self.n_offsets, nn.Tanh()), "mlp_cov": network(7 * self.n_offsets),
                         "mlp_color": network(3 * self.n_offsets, nn.Sigmoid())}

    get_anchor = property(lambda self: self._anchor)
    get_scaling = property(lambda self: self._scaling.exp())
    get_rotation = property(lambda self: normalize(self._rotation))
    get_mask = property(lambda self: Binary.apply(self._mask)[:, :self.n_offsets])
    get_opacity_mlp = property(lambda self: self.networks["mlp_opacity"])
    get_cov_mlp = property(lambda self: self.networks["mlp_cov"])
    get_color_mlp = property(lambda self: self.networks["mlp_color"])
    learns = property(lambda self: any(network.training for network in self.networks.values()))

    def train(self, training=True):
        for network in self.networks.values():
            network.train(training)

    def eval(self):
        self.train(False)

    def new_anchors(self, positions, features, size):
        """Values of every field, for anchors of this size (a number, or [N, 1])."""
        count = len(positions)
        turned = torch.zeros_like(positions[:, :1]).repeat(1, 4)
        turned[:, 0] = 1
        return {"anchor": positions, "offset": positions.new_zeros(count, self.n_offsets, 3),
                "mask": positions.new_ones(count, self.n_offsets + self.mask_columns, 1), "anchor_feat": features,
                "scaling": (positions.new_ones(count, 6) * size).log(), "rotation": turned}

    def create_from_pcd(self, pcd, spatial_lr_scale, data_device):
        cells = (torch.tensor(pcd.points, device=data_device) / self.voxel_size).round().unique(dim=0)
        positions = cells * self.voxel_size
        size = 0.4 * distCUDA2(positions).clamp_min(1e-7).sqrt()[:, None]
        start = self.new_anchors(positions, 0.1 * torch.randn(len(positions), self.feat_dim, device=data_device), size)
        start["offset"] += 0.5 * torch.randn_like(start["offset"])
        for name, field in self.FIELDS.items():
            setattr(self, field, nn.Parameter(start[name]))
        for network in self.networks.values():
            network.to(data_device)

    def training_setup(self, opt):
        rates = {"anchor": 0.0, "offset": opt.offset_lr_init, "mask": opt.mask_lr_init,
                 "anchor_feat": opt.feature_lr, "scaling": opt.scaling_lr, "rotation": 0.0,
                 "mlp_opacity": opt.mlp_opacity_lr_init, "mlp_cov": opt.mlp_cov_lr_init,
                 "mlp_color": opt.mlp_color_lr_init}
        groups = [{"name": name, "lr": rate,
                   "params": [getattr(self, self.FIELDS[name])] if name in self.FIELDS
                   else list(self.networks[name].parameters())} for name, rate in rates.items()]
        self.optimizer = Adam(groups, lr=0.0, eps=1e-15)
        self.optimizers = (self.optimizer,)
        count = len(self._anchor)
        self.opacity_accum, self.anchor_demon = self._anchor.new_zeros(2, count, 1)
        self.offset_gradient_accum, self.offset_denom = self._anchor.new_zeros(2, count * self.n_offsets, 1)

    def training_statis(self, screen_points, opacity, seen, made, visible):
        """screen_points: of the Gaussians made; seen: which of them have a radius; visible: which anchors have one."""
        self.opacity_accum[visible] += opacity.detach().clamp_min(0).view(-1, self.n_offsets).sum(dim=1, keepdim=True)
        self.anchor_demon[visible] += 1
        chosen = visible.repeat_interleave(self.n_offsets).nonzero()[:, 0][made][seen]
        self.offset_gradient_accum[chosen] += screen_points.grad[seen, :2].norm(dim=-1, keepdim=True)
        self.offset_denom[chosen] += 1

    def adjust_anchor(self, check_interval, success_threshold, grad_threshold, min_opacity):
        often = self.offset_denom[:, 0] >= check_interval * success_threshold
        steepness = (self.offset_gradient_accum / self.offset_denom).nan_to_num(0.0)[:, 0]
        self.anchor_growing(steepness * often, grad_threshold)

        poor = self.opacity_accum[:, 0] < min_opacity * self.anchor_demon[:, 0]
        self.prune_anchor(poor & (self.anchor_demon[:, 0] >= check_interval * success_threshold))

    def anchor_growing(self, steepness, threshold):
        """New anchors in the empty cells of ever finer grids where Gaussians want to move."""
        positions = (self._anchor[:, None] + self._offset * self.get_scaling[:, None, :3]).detach().flatten(0, 1)
        features = self._anchor_feat.detach().repeat_interleave(self.n_offsets, dim=0)
        for depth, size in enumerate(self.cell_sizes):
            mask = (steepness >= threshold * 2 ** depth) & (torch.rand_like(steepness) > 0.5 ** (depth + 1))
            if not bool(mask.any()):
                continue
            cells, owners = torch.unique((positions[mask] / size).round().int(), dim=0, return_inverse=True)
            best = scatter_max(features[mask], owners[:, None].expand(-1, self.feat_dim), dim=0)[0]
            taken = (self._anchor.detach() / size).round()
            empty = (cells[:, None] != taken).any(dim=-1).all(dim=1)
            self.add_rows(self.new_anchors(cells[empty] * size, best[empty], size))
            for name, each in (("opacity_accum", 1), ("anchor_demon", 1), ("offset_gradient_accum", self.n_offsets),
                               ("offset_denom", self.n_offsets)):
                old = getattr(self, name)
                setattr(self, name, torch.cat([old, old.new_zeros(each * int(empty.sum()), 1)]))

    def prune_anchor(self, poor):
        self.keep_rows(~poor)
        offsets = (~poor).repeat_interleave(self.n_offsets)
        self.opacity_accum, self.anchor_demon = self.opacity_accum[~poor], self.anchor_demon[~poor]
        self.offset_gradient_accum = self.offset_gradient_accum[offsets]
        self.offset_denom = self.offset_denom[offsets]

    def save(self, path):
        super().save(path)
        torch.save({name: network.state_dict() for name, network in self.networks.items()},
                   os.path.join(os.path.dirname(path), "networks.pt"))

    def load(self, path, data_device):
        super().load(path, data_device)
        for name, weights in torch.load(os.path.join(os.path.dirname(path), "networks.pt")).items():
            self.networks[name].load_state_dict(weights)
