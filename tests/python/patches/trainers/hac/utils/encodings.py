import torch


class Binary(torch.autograd.Function):
    """1 where positive, else 0; the gradient passes."""

    @staticmethod
    def forward(context, tensor):
        return (tensor > 0).to(tensor.dtype)

    @staticmethod
    def backward(context, gradient):
        return gradient


class Stepped(torch.autograd.Function):
    """To multiples of `step`; the gradient passes."""

    @staticmethod
    def forward(context, tensor, step):
        return (tensor / step).round() * step

    @staticmethod
    def backward(context, gradient):
        return gradient, None


def mask_bits(masks):
    """Share of ones, and the bits that an ideal coder spends on the masks."""
    share = float(masks.mean().clamp(1e-6, 1 - 1e-6))
    entropy = -share * torch.tensor(share).log2() - (1 - share) * torch.tensor(1 - share).log2()
    return share, float(entropy) * masks.numel()
