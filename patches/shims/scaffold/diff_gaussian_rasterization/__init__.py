"""For `dsmoe run`: what a trainer imports from diff_gaussian_rasterization, from this project's module scaffold."""
from diff_smoe_rasterization.integrations.scaffold import *  # noqa: F401, F403
from diff_smoe_rasterization.patches.runtime import say_rasterizer

say_rasterizer("scaffold")
