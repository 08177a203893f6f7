import os

from utils.groups import ParamGroup, get_combined_args  # noqa: F401  (callers take it from here)


class ModelParams(ParamGroup):
    def __init__(self, parser, sentinel=False):
        self.eval = self._white_background = False
        self.data_device, self._images, self._model_path, self._source_path = "cpu", "images", "", ""
        self._resolution, self.sh_degree = -1, 1
        super().__init__(parser, "What is loaded", sentinel)

    def extract(self, args):
        taken = super().extract(args)
        taken.source_path = os.path.abspath(taken.source_path)
        return taken


class PipelineParams(ParamGroup):
    def __init__(self, parser):
        self.convert_SHs_python = self.compute_cov3D_python = self.debug = False
        super().__init__(parser, "How it is rendered", False)


class CompressionParams(ParamGroup):
    def __init__(self, parser):
        self.finetune_iterations, self.load_iteration = 4, -1
        self.color_codebook_size, self.gaussian_codebook_size = 64, 48
        self.color_cluster_iterations = self.gaussian_cluster_iterations = 4
        self.color_importance_include, self.gaussian_importance_include = 0.6, 0.6
        self.prune_threshold = 0.0
        self.start_checkpoint, self.output_vq = "", "eval_vq"
        super().__init__(parser, "How it is compressed", False)


class OptimizationParams(ParamGroup):
    def __init__(self, parser):
        self.iterations = 7
        self.position_lr_init, self.feature_lr, self.scaling_lr, self.rotation_lr = 0.001, 0.01, 0.01, 0.01
        self.opacity_lr, self.lambda_dssim = 0.02, 0.25
        self.not_quantization_aware = False
        super().__init__(parser, "How it is trained", False)
