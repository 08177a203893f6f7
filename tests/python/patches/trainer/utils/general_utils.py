import os
import random

import numpy as np
import torch
from PIL import Image


def safe_state(silent):
    """Seeds every generator; `silent` is there for the sake of its callers."""
    for seed in (torch.manual_seed, np.random.seed, random.seed):
        seed(0)


def endlessly(cameras):
    """The cameras in a random order, over and over."""
    while True:
        for index in torch.randperm(len(cameras)).tolist():
            yield cameras[index]


def background_of(params):
    return torch.full((3,), float(params.white_background), device=params.data_device)


def psnr(img1, img2):
    return -10 * ((img1 - img2) ** 2).mean().log10()


def save_image(image, path):
    """Writes a [3, H, W] image as 8-bit PNG."""
    os.makedirs(os.path.dirname(path), exist_ok=True)
    pixels = image.detach().cpu().clamp(0, 1).mul(255).round().permute(1, 2, 0)
    Image.fromarray(pixels.numpy().astype(np.uint8)).save(path)


class Adam:
    """Adam as in torch.optim, whose first use imports all of torch._dynamo: seconds, in every process of a test."""

    def __init__(self, params, lr, eps):
        self.param_groups, self.state, self.eps = [{"lr": lr, **group} for group in params], {}, eps

    @torch.no_grad()
    def step(self):
        for group in self.param_groups:
            for tensor in group["params"]:
                if tensor.grad is None:
                    continue
                count, mean, square = self.state.get(tensor, (0, torch.zeros_like(tensor), torch.zeros_like(tensor)))
                self.state[tensor] = count, mean, square = (
                    count + 1, mean.lerp(tensor.grad, 0.1), square.lerp(tensor.grad ** 2, 0.001))
                deviation = (square / (1 - 0.999 ** count)).sqrt() + self.eps
                tensor -= group["lr"] * mean / (1 - 0.9 ** count) / deviation

    def zero_grad(self):
        for group in self.param_groups:
            for tensor in group["params"]:
                tensor.grad = None
