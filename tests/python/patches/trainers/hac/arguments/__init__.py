import os

from utils.groups import ParamGroup, get_combined_args  # noqa: F401  (callers take it from here)


class ModelParams(ParamGroup):
    def __init__(self, parser, sentinel=False):
        self.use_feat_bank = self._white_background = False
        self.data_device, self._images, self._model_path, self._source_path = "cpu", "images", "", ""
        self._resolution, self.sh_degree, self.lod, self.eval = -1, 1, 0, True
        self.voxel_size, self.n_offsets, self.feat_dim = 0.1, 4, 12
        self.update_init_factor, self.update_hierarchy_factor, self.update_depth = 4, 2, 2
        super().__init__(parser, "What is loaded", sentinel)

    def extract(self, args):
        taken = super().extract(args)
        taken.source_path = os.path.abspath(taken.source_path)
        return taken


class PipelineParams(ParamGroup):
    def __init__(self, parser):
        self.convert_SHs_python = self.compute_cov3D_python = self.debug = False
        super().__init__(parser, "How it is rendered", False)


class OptimizationParams(ParamGroup):
    def __init__(self, parser):
        self.iterations = 7
        self.offset_lr_init, self.mask_lr_init, self.feature_lr, self.scaling_lr = 0.01, 0.01, 0.02, 0.01
        self.mlp_opacity_lr_init, self.mlp_cov_lr_init, self.mlp_color_lr_init = 0.01, 0.004, 0.008
        self.lambda_dssim = 0.25
        self.start_stat, self.update_from, self.update_interval, self.update_until = 0, 1, 2, 6
        self.min_opacity, self.success_threshold, self.densify_grad_threshold = 0.005, 0.2, 0.0001
        super().__init__(parser, "How it is trained", False)
