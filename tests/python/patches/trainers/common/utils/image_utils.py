import os

import numpy as np
from PIL import Image


def psnr(img1, img2):
    return -10 * ((img1 - img2) ** 2).mean().log10()


def save_image(image, path):
    """Writes a [3, H, W] image as 8-bit PNG."""
    os.makedirs(os.path.dirname(path), exist_ok=True)
    pixels = image.detach().cpu().clamp(0, 1).mul(255).round().permute(1, 2, 0)
    Image.fromarray(pixels.numpy().astype(np.uint8)).save(path)
