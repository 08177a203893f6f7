import os
from glob import glob

from arguments import ModelParams
from scene.dataset_readers import Camera, read_made_up_scene
from scene.gaussian_model import GaussianModel


class Scene:
    def __init__(self, args: ModelParams, gaussians: GaussianModel, load_iteration=None, shuffle=True):
        self.model_path, self.gaussians, self.loaded_iter = args.model_path, gaussians, load_iteration
        made = read_made_up_scene(args.source_path)
        self.train_cameras, self.test_cameras = ([Camera(view, args.data_device) for view in views]
                                                 for views in (made.shown, made.hidden))
        if load_iteration is None:
            gaussians.create_from_pcd(made.points, made.colors, args.data_device)
            return
        if load_iteration < 0:
            self.loaded_iter = max(int(folder.rpartition("_")[2]) for folder in glob(self._folder("*")))
        gaussians.load(os.path.join(self._folder(self.loaded_iter), "point_cloud.npz"), args.data_device)

    def _folder(self, iteration):
        return os.path.join(self.model_path, "point_cloud", f"iteration_{iteration}")

    def save(self, iteration):
        os.makedirs(self._folder(iteration), exist_ok=True)
        self.gaussians.save(os.path.join(self._folder(iteration), "point_cloud.npz"))

    def getTrainCameras(self):
        return self.train_cameras

    def getTestCameras(self):
        return self.test_cameras
