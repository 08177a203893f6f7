import os
from argparse import Namespace

import torch


def endlessly(cameras):
    """The cameras in a random order, over and over."""
    while True:
        for index in torch.randperm(len(cameras)).tolist():
            yield cameras[index]


def background_of(params):
    return torch.full((3,), float(params.white_background), device=params.data_device)


def write_cfg_args(folder, params):
    """What render.py reads again."""
    os.makedirs(folder, exist_ok=True)
    with open(os.path.join(folder, "cfg_args"), "w") as file:
        file.write(repr(Namespace(**vars(params))))
