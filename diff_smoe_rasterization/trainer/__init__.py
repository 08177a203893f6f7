"""The native trainer: scenes in, Gaussians out, through the package's public `rasterize` alone.

One idea a file: config (all options), scene (COLMAP and NeRF-synthetic loaders), cameras, synthetic (a ray-traced
scene), model (parameters and optimizer), strategy (densification), losses, metrics, checkpoint, loop, quickstart.
"""
