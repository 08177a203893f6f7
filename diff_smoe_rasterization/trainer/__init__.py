"""The native trainer: scenes in, Gaussians out, through the package's public `rasterize` alone."""
