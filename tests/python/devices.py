"""On which devices the tests run, and tensors that hold the same values on each of them."""
from __future__ import annotations

import contextlib

import torch


def without_cuda_because():
    """Returns why nothing can be tested on a GPU here; None if it can."""
    try:
        from diff_smoe_rasterization.extension import BACKENDS, build_info
    except ImportError as error:
        return str(error)
    if "cuda" not in BACKENDS:
        return build_info()["without_cuda_because"] or "this build has no CUDA backend"
    if not torch.cuda.is_available():
        return f"torch {torch.__version__} finds no GPU"
    if not hasattr(torch, "set_default_device"):
        return f"torch {torch.__version__} has no default device, by which these tests choose theirs (torch 2.0 has)"
    return None


def default_device():
    """Returns the device on which torch's factory functions create tensors."""
    return torch.empty(0).device


@contextlib.contextmanager
def on_the_cpu():
    """Factory functions create tensors on the CPU within, whatever the default device is."""
    if not hasattr(torch, "set_default_device"):
        yield
        return
    with torch.device("cpu"):
        yield


def random_normal(shape, seed, dtype=torch.float64):
    """Returns standard normal numbers [shape] on the default device, drawn on the CPU: every device has its own."""
    generator = torch.Generator(device="cpu").manual_seed(seed)
    values = torch.randn(shape, generator=generator, dtype=torch.float64, device="cpu")
    return values.to(device=default_device(), dtype=dtype)
