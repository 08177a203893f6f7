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


def get_combined_args(parser: ArgumentParser, cmd=None):
    """The flags of the command line over those of the model's cfg_args."""
    typed = parser.parse_args(sys.argv[1:] if cmd is None else cmd)
    with open(os.path.join(typed.model_path, "cfg_args")) as file:
        saved = eval(file.read())
    return Namespace(**{**vars(saved), **{key: value for key, value in vars(typed).items() if value is not None}})
