import torch

from utils.graphics_utils import getProjectionMatrix, getWorld2View2


class Camera:
    """One view of the made-up scene: its matrices, transposed as the rasterizer wants them, and its picture."""

    def __init__(self, R, T, FoVx, FoVy, image, image_name, data_device):
        self.FoVx, self.FoVy, self.image_name = FoVx, FoVy, image_name
        self.original_image = torch.tensor(image).to(data_device)
        _, self.image_height, self.image_width = image.shape
        self.world_view_transform = torch.tensor(getWorld2View2(R, T)).T.contiguous().to(data_device)
        projection = getProjectionMatrix(0.01, 100.0, FoVx, FoVy).T.to(data_device)
        self.full_proj_transform = self.world_view_transform @ projection
        self.camera_center = self.world_view_transform.inverse()[3, :3]
        self.alpha_mask = None
        self.depth_reliable = True
        self.invdepthmap = torch.full((1, self.image_height, self.image_width), 1 / 3.0, device=data_device)
        self.depth_mask = torch.ones_like(self.invdepthmap)
