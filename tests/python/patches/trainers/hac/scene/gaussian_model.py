from scene.anchors import Anchors


class GaussianModel(Anchors):
    def __init__(self, feat_dim, n_offsets, voxel_size, update_depth, update_init_factor, update_hierachy_factor,
                 use_feat_bank=False, n_features_per_level=2, log2_hashmap_size=13, log2_hashmap_size_2D=15,
                 decoded_version=False):
        super().__init__(feat_dim, n_offsets, voxel_size, update_depth, update_init_factor, update_hierachy_factor)
        self.decoded_version = decoded_version
