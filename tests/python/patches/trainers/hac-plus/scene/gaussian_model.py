from scene.anchors import Anchors


class GaussianModel(Anchors):
    """A mask for each offset, and one for the anchor."""

    mask_columns = 1
