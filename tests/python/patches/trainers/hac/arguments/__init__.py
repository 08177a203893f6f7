import os
import sys
from argparse import ArgumentParser, Namespace


class ParamGroup:
    """A group of flags: one for every attribute; a leading underscore asks for a short form too."""

    def __init__(self, parser: ArgumentParser, title, no_defaults):
        flags = parser.add_argument_group(title)
        for attribute, default in vars(self).items():
            name = attribute.lstrip("_")
            spellings = ["--" + name] + ["-" + name[0]] * attribute.startswith("_")
            kind = {"action": "store_true"} if isinstance(default, bool) else {"type": type(default)}
            flags.add_argument(*spellings, default=None if no_defaults else default, **kind)

    def extract(self, args):
        names = {attribute.lstrip("_") for attribute in vars(self)}
        return Namespace(**{key: value for key, value in vars(args).items() if key in names})


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


def get_combined_args(parser: ArgumentParser):
    """The flags of the command line over those of the model's cfg_args."""
    typed = parser.parse_args(sys.argv[1:])
    with open(os.path.join(typed.model_path, "cfg_args")) as file:
        saved = eval(file.read())
    return Namespace(**{**vars(saved), **{key: value for key, value in vars(typed).items() if value is not None}})
