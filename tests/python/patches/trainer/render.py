import os
from argparse import ArgumentParser

import torch

from arguments import ModelParams, PipelineParams, get_combined_args
from gaussian_renderer import GaussianModel, render
from scene import Scene
from utils.general_utils import background_of, safe_state, save_image


def render_sets(dataset: ModelParams, iteration: int, pipeline: PipelineParams, skip_train: bool, skip_test: bool):
    with torch.no_grad():
        model = GaussianModel(dataset.sh_degree)
        world = Scene(dataset, model, load_iteration=iteration, shuffle=False)
        sets = {"train": [] if skip_train else world.getTrainCameras(),
                "test": [] if skip_test else world.getTestCameras()}
        for name, views in sets.items():
            for index, view in enumerate(views):
                image = render(view, model, pipeline, background_of(dataset))["render"]
                save_image(image, os.path.join(dataset.model_path, name, f"ours_{world.loaded_iter}", "renders",
                                               f"{index:05d}.png"))


if __name__ == "__main__":
    flags = ArgumentParser(description="Renders the views of a trained model.")
    model_flags, pipe_flags = ModelParams(flags, sentinel=True), PipelineParams(flags)
    flags.add_argument("--iteration", type=int, default=-1)
    for name in ("skip_train", "skip_test", "quiet"):
        flags.add_argument("--" + name, action="store_true")
    args = get_combined_args(flags)
    safe_state(args.quiet)
    render_sets(model_flags.extract(args), args.iteration, pipe_flags.extract(args), args.skip_train, args.skip_test)
