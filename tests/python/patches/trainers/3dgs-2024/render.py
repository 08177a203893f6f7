import os
from argparse import ArgumentParser

import torch

from arguments import ModelParams, PipelineParams, get_combined_args
from gaussian_renderer import GaussianModel, render
from scene import Scene
from utils.flags import RENDERING, add_flags
from utils.general_utils import safe_state
from utils.image_utils import save_image
from utils.loops import background_of

try:
    from diff_gaussian_rasterization import SparseGaussianAdam
    HAS_SPARSE_ADAM = True
except ImportError:
    HAS_SPARSE_ADAM = False


def save_pictures(output, views, gaussians, pipeline, background, train_test_exp, separate_sh):
    folder = os.path.join(output, "renders")
    for index, view in enumerate(views):
        result = render(view, gaussians, pipeline, background, use_trained_exp=train_test_exp, separate_sh=separate_sh)
        save_image(result["render"], os.path.join(folder, f"{index:05d}.png"))


def render_sets(dataset: ModelParams, iteration: int, pipeline: PipelineParams, skip_train: bool, skip_test: bool,
                separate_sh: bool):
    with torch.no_grad():
        model = GaussianModel(dataset.sh_degree)
        world = Scene(dataset, model, load_iteration=iteration, shuffle=False)
        sets = {"train": world.getTrainCameras()} if not skip_train else {}
        if not skip_test:
            sets["test"] = world.getTestCameras()
        for name, views in sets.items():
            output = os.path.join(dataset.model_path, name, f"ours_{world.loaded_iter}")
            save_pictures(output, views, model, pipeline, background_of(dataset), dataset.train_test_exp, separate_sh)


if __name__ == "__main__":
    flags = ArgumentParser(description="Renders the views of a trained model.")
    model_flags, pipe_flags = ModelParams(flags, sentinel=True), PipelineParams(flags)
    add_flags(flags, **RENDERING)
    args = get_combined_args(flags)

    safe_state(args.quiet)
    render_sets(model_flags.extract(args), args.iteration, pipe_flags.extract(args), args.skip_train, args.skip_test,
                HAS_SPARSE_ADAM)
