import os
import sys
from argparse import ArgumentParser, Namespace


class ParamGroup:
    """A group of flags: one for every attribute; a leading underscore asks for a short form too."""

    def __init__(self, parser: ArgumentParser, title, no_defaults=False):
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
        self.eval = self.train_test_exp = self._white_background = False
        self.data_device, self._images, self._model_path, self._source_path = "cpu", "images", "", ""
        self.sh_degree = 1
        super().__init__(parser, "What is loaded", sentinel)

    def extract(self, args):
        taken = super().extract(args)
        taken.source_path = os.path.abspath(taken.source_path)
        return taken


class PipelineParams(ParamGroup):
    def __init__(self, parser):
        self.debug = False
        super().__init__(parser, "How it is rendered")


class OptimizationParams(ParamGroup):
    def __init__(self, parser):
        self.iterations = 7
        self.position_lr_init, self.feature_lr, self.opacity_lr, self.scaling_lr = 0.002, 0.02, 0.05, 0.02
        self.lambda_dssim, self.densify_grad_threshold, self.densification_interval = 0.25, 0.0001, 2
        self.random_background = False
        super().__init__(parser, "How it is trained")


def training_flags(parser: ArgumentParser):
    """Those of the script itself."""
    for name, default in (("ip", "127.0.0.1"), ("port", 6009), ("debug_from", -1), ("start_checkpoint", "")):
        parser.add_argument("--" + name, type=type(default), default=default)
    for name, default in (("test_iterations", [7]), ("save_iterations", []), ("checkpoint_iterations", [])):
        parser.add_argument("--" + name, type=int, nargs="+", default=default)
    parser.add_argument("--quiet", action="store_true")


def get_combined_args(parser: ArgumentParser):
    """The flags of the command line over those of the model's cfg_args."""
    typed = parser.parse_args(sys.argv[1:])
    with open(os.path.join(typed.model_path, "cfg_args")) as file:
        saved = eval(file.read())
    return Namespace(**{**vars(saved), **{key: value for key, value in vars(typed).items() if value is not None}})
