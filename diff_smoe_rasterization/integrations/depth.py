"""The API of rasterizers that return color, radii, depth: of 4DGaussians, Deformable 3D Gaussians, SplaTAM.

The depth is sum(w z) in `alpha`. `means2D_densify`, which Deformable 3D Gaussians passes, receives the gradient of
`means2D` too. In these rasterizers' own alpha mode the depth had no gradient or one by the weights only; here it is
the whole.
"""
from ._rasterizer import classes_of

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians = classes_of("depth", __name__)
