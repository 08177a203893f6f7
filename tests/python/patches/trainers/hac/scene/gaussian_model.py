import numpy as np
import torch
from simple_knn._C import distCUDA2
from torch import nn
from torch_scatter import scatter_max
from utils.encodings import Rounded
from utils.general_utils import Adam


class GaussianModel:
    """Anchors on a grid; a small network makes `n_offsets` Gaussians of each."""

    FIELDS = ("_anchor", "_offset", "_anchor_feat", "_scaling", "_rotation")

    def __init__(self, params):
        self.voxel_size, self.n_offsets, feat_dim = params.voxel_size, params.n_offsets, params.feat_dim
        self.network = nn.Sequential(nn.Linear(feat_dim, feat_dim), nn.ReLU(), nn.Linear(feat_dim, 11 * self.n_offsets))

    get_anchor = property(lambda self: self._anchor)
    get_scaling = property(lambda self: self._scaling.exp())
    get_rotation = property(lambda self: nn.functional.normalize(self._rotation))
    _features = property(lambda self: Rounded.apply(self._anchor_feat, 0.01))

    def create_from_pcd(self, points, colors, data_device):
        cells = (torch.tensor(points, device=data_device) / self.voxel_size).round().int()
        cells, owners = torch.unique(cells, dim=0, return_inverse=True)
        anchors = cells.unique(dim=0) * self.voxel_size
        made = torch.randn(len(points), self.network[0].in_features, device=data_device)
        features = scatter_max(made, owners[:, None].expand_as(made), dim=0)[0]
        scaling = (0.4 * distCUDA2(anchors).clamp_min(1e-7).sqrt()).log()[:, None].repeat(1, 3)
        rows = (anchors, torch.randn(len(anchors), self.n_offsets, 3, device=data_device), features, scaling,
                torch.ones(len(anchors), 4, device=data_device))
        for field, values in zip(self.FIELDS, rows):
            setattr(self, field, nn.Parameter(values))
        self.network.to(data_device)

    def training_setup(self, opt):
        rates = dict(zip(self.FIELDS, (0.0, 0.01, opt.feature_lr, opt.scaling_lr, 0.0)))
        self.optimizer = Adam([{"params": [getattr(self, field)], "lr": rate} for field, rate in rates.items()]
                              + [{"params": list(self.network.parameters()), "lr": 0.008}], lr=0.0, eps=1e-15)

    def save(self, path):
        np.savez(path, **{field: getattr(self, field).detach().cpu().numpy() for field in self.FIELDS})
        torch.save(self.network.state_dict(), path + ".network")

    def load(self, path, data_device):
        with np.load(path) as saved:
            for field in self.FIELDS:
                setattr(self, field, nn.Parameter(torch.tensor(saved[field], device=data_device)))
        self.network.load_state_dict(torch.load(path + ".network"))
        self.network.to(data_device)
