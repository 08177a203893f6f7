def sorted_cells(anchors, voxel_size):
    """The anchors' cells in the order in which a coder of point clouds writes them."""
    return (anchors / voxel_size).round().int().unique(dim=0)
