import torch


class Rounded(torch.autograd.Function):
    """To multiples of `step`; the gradient passes."""

    @staticmethod
    def forward(context, tensor, step):
        return (tensor / step).round() * step

    @staticmethod
    def backward(context, gradient):
        return gradient, None
