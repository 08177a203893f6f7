"""SparseGaussianAdam for a patched 3DGS of 2024 whose command line asks for it; else an ImportError.

3DGS asks by `--optimizer_type sparse_adam`. Wherever it finds the optimizer it renders another way, which forks for the
rasterizer's branch without it have often broken. So by default they find none, as with that branch.
"""
import sys

from .facts import ASKS_FOR_SPARSE_ADAM

if not any(ASKS_FOR_SPARSE_ADAM in word for word in sys.argv):
    raise ImportError(f"SparseGaussianAdam is for a command line with {ASKS_FOR_SPARSE_ADAM}")

from diff_smoe_rasterization import SparseGaussianAdam  # noqa: E402,F401
