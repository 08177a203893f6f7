import numpy as np
import torch
from torch import nn
from torch.nn.functional import normalize
from utils.adam import Adam
from utils.general_utils import build_covariance


class Rounding(torch.autograd.Function):
    """To `levels` values over the tensor's range; the gradient passes."""

    @staticmethod
    def forward(context, tensor, levels):
        step = (tensor.max() - tensor.min()).clamp_min(1e-12) / (levels - 1)
        return (tensor / step).round() * step

    @staticmethod
    def backward(context, gradient):
        return gradient, None


class GaussianModel:
    """A trained model, whose colours and shapes become rows of codebooks."""

    TENSORS = ("_xyz", "_features_dc", "_features_rest", "_opacity", "_scaling", "_scaling_factor", "_rotation")

    def __init__(self, degree, quantization=True):
        self.active_sh_degree = self.full_sh_degree = degree
        self.levels = 256 if quantization else None
        self._feature_indices = self._gaussian_indices = None

    def rounded(self, tensor):
        return tensor if self.levels is None else Rounding.apply(tensor, self.levels)

    has_codebooks = property(lambda self: self._gaussian_indices is not None and self._feature_indices is not None)
    get_xyz = property(lambda self: self._xyz)
    get_opacity = property(lambda self: self.rounded(self._opacity.sigmoid()))
    get_scaling_factor = property(lambda self: self.rounded(self._scaling_factor).exp())
    get_scaling_normalized = property(lambda self: self.rounded(normalize(self._scaling.relu())))
    _rotation_post_activation = property(lambda self: self.rounded(normalize(self._rotation)))

    @property
    def _get_features_raw(self):
        return torch.cat([self.rounded(self._features_dc), self.rounded(self._features_rest)], dim=1)

    @property
    def get_features(self):
        raw = self._get_features_raw
        return raw if self._feature_indices is None else raw[self._feature_indices]

    @property
    def get_scaling(self):
        shapes = self.get_scaling_normalized
        return self.get_scaling_factor * (shapes if self._gaussian_indices is None else shapes[self._gaussian_indices])

    @property
    def get_rotation(self):
        turned = self._rotation_post_activation
        return turned if self._gaussian_indices is None else turned[self._gaussian_indices]

    def get_covariance(self, scaling_modifier=1.0):
        return build_covariance(scaling_modifier * self.get_scaling, self.get_rotation)

    def get_normalized_covariance(self):
        return build_covariance(self.get_scaling_normalized, self._rotation)

    def load(self, path, data_device):
        """A model of a 3DGS trainer, or what `save` wrote."""
        with np.load(path) as file:
            saved = {name: torch.tensor(file[name], device=data_device) for name in file.files}
        if "xyz" in saved:
            scales = saved["scaling"].exp()
            factor = scales.norm(dim=1, keepdim=True)
            values = [saved["xyz"], saved["f_dc"], saved["f_rest"], saved["opacity"], scales / factor, factor.log(),
                      saved["rotation"]]
            saved = dict(zip(self.TENSORS, values))
        for name in self.TENSORS:
            setattr(self, name, nn.Parameter(saved[name]))
        if "_feature_indices" in saved:
            self.set_color_indexed(self._features_dc, self._features_rest, saved["_feature_indices"])
            self.set_gaussian_indexed(self._rotation, self._scaling, saved["_gaussian_indices"])

    def save_npz(self, path):
        arrays = {name: getattr(self, name).detach().cpu().numpy() for name in self.TENSORS}
        if self.has_codebooks:
            arrays["_feature_indices"] = self._feature_indices.cpu().numpy()
            arrays["_gaussian_indices"] = self._gaussian_indices.cpu().numpy()
        np.savez(path, **arrays)

    def mask_splats(self, mask):
        for name in self.TENSORS:
            setattr(self, name, nn.Parameter(getattr(self, name).detach()[mask]))

    def set_color_indexed(self, dc, rest, indices):
        self._features_dc, self._features_rest = nn.Parameter(dc.detach()), nn.Parameter(rest.detach())
        self._feature_indices = indices

    def set_gaussian_indexed(self, rotation, scaling, indices):
        self._rotation, self._scaling = nn.Parameter(rotation.detach()), nn.Parameter(scaling.detach())
        self._gaussian_indices = indices

    def training_setup(self, opt):
        rates = (opt.position_lr_init, opt.feature_lr, opt.feature_lr / 20, opt.opacity_lr, opt.scaling_lr,
                 opt.scaling_lr, opt.rotation_lr)
        self.optimizer = Adam([{"params": [getattr(self, name)], "lr": rate}
                               for name, rate in zip(self.TENSORS, rates)], lr=0.0, eps=1e-15)
