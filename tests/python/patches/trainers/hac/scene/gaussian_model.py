from scene.anchors import Anchors


class GaussianModel(Anchors):
    """A mask for each offset."""
