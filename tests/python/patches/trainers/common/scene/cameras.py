import torch

from utils.graphics_utils import perspective, world_to_view


class Camera:
    """One view of the made-up scene: its matrices, transposed as the rasterizer wants them, and its picture."""

    def __init__(self, R, T, FoVx, FoVy, image, image_name, data_device):
        self.FoVx, self.FoVy, self.image_name = FoVx, FoVy, image_name
        self.original_image = torch.tensor(image).to(data_device)
        _, self.image_height, self.image_width = image.shape
        self.world_view_transform = torch.tensor(world_to_view(R, T)).T.contiguous().to(data_device)
        projection = perspective(0.01, 100.0, FoVx, FoVy).T.to(data_device)
        self.full_proj_transform = self.world_view_transform @ projection
        self.camera_center = torch.tensor(-R @ T).to(data_device)
        self.alpha_mask = None
        self.depth_reliable = True
        self.invdepthmap = torch.full((1, self.image_height, self.image_width), 1 / 3.0, device=data_device)
        self.depth_mask = torch.ones_like(self.invdepthmap)
