import os

from utils.groups import ParamGroup, get_combined_args  # noqa: F401  (callers take it from here)


class ModelParams(ParamGroup):
    def __init__(self, parser, sentinel=False):
        self.eval = self.train_test_exp = self._white_background = False
        self.data_device, self._images, self._model_path, self._source_path = "cpu", "images", "", ""
        self._resolution, self.sh_degree, self._depths = -1, 1, ""
        super().__init__(parser, "What is loaded", sentinel)

    def extract(self, args):
        taken = super().extract(args)
        taken.source_path = os.path.abspath(taken.source_path)
        return taken


class PipelineParams(ParamGroup):
    def __init__(self, parser):
        self.convert_SHs_python = self.compute_cov3D_python = self.debug = self.antialiasing = False
        super().__init__(parser, "How it is rendered", False)


class OptimizationParams(ParamGroup):
    def __init__(self, parser):
        self.iterations = 7
        self.position_lr_init, self.position_lr_final = 0.002, 0.001
        self.feature_lr, self.opacity_lr, self.scaling_lr, self.rotation_lr = 0.02, 0.05, 0.02, 0.01
        self.percent_dense, self.densify_grad_threshold = 0.02, 0.0001
        self.lambda_dssim, self.exposure_lr_init = 0.25, 0.02
        self.depth_l1_weight_init, self.depth_l1_weight_final = 0.5, 0.1
        self.optimizer_type = "default"
        self.densification_interval, self.opacity_reset_interval = 2, 5
        self.densify_from_iter, self.densify_until_iter = 1, 6
        self.random_background = False
        super().__init__(parser, "How it is trained", False)
