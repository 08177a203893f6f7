"""A distance with the call of the package `lpips`, which downloads a network; here, of edges."""
import torch


class LPIPS(torch.nn.Module):
    def __init__(self, net="alex"):
        super().__init__()

    def forward(self, image, target, normalize=False):
        return ((image - target)[..., 1:] - (image - target)[..., :-1]).abs().mean()
