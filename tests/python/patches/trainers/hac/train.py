import logging
import os
from argparse import ArgumentParser, Namespace

import torch
from tqdm import tqdm

from arguments import ModelParams, OptimizationParams, PipelineParams, training_flags
from gaussian_renderer import prefilter_voxel, render
from scene import GaussianModel, Scene
from utils.general_utils import background_of, endlessly, safe_state, save_image
from utils.loss_utils import l1_loss, ssim


def training(args_param, dataset, opt, pipe, saving_iterations, logger=None):
    with open(os.path.join(dataset.model_path, "cfg_args"), "w") as file:
        file.write(repr(Namespace(**vars(dataset))))
    model = GaussianModel(dataset)
    world = Scene(dataset, model)
    model.training_setup(opt)
    fixed = background_of(dataset)
    views = endlessly(world.getTrainCameras())
    for step in tqdm(range(1, opt.iterations + 1)):
        view = next(views)
        result = render(view, model, pipe, fixed, visible_mask=prefilter_voxel(view, model, pipe, fixed))
        image, target = result["render"], view.original_image
        loss = torch.lerp(l1_loss(image, target), 1 - ssim(image, target), opt.lambda_dssim)
        loss.backward()
        logger.info(f"step {step}: loss {loss.item():.9g}")
        with torch.no_grad():
            if step in saving_iterations:
                world.save(step)
            model.optimizer.step()
            model.optimizer.zero_grad()


def render_sets(args_param, dataset: ModelParams, iteration: int, pipeline: PipelineParams, logger=None):
    with torch.no_grad():
        model = GaussianModel(dataset)
        world = Scene(dataset, model, load_iteration=iteration, shuffle=False)
        background = background_of(dataset)
        for index, view in enumerate(world.getTestCameras()):
            visible = prefilter_voxel(view, model, pipeline, background)
            image = render(view, model, pipeline, background, visible_mask=visible)["render"]
            save_image(image, os.path.join(dataset.model_path, "test", f"ours_{world.loaded_iter}", "renders",
                                           f"{index:05d}.png"))


if __name__ == "__main__":
    flags = ArgumentParser(description="Trains anchors and their network for a few steps, and renders the result.")
    model_flags, step_flags, pipe_flags = ModelParams(flags), OptimizationParams(flags), PipelineParams(flags)
    training_flags(flags)
    args = flags.parse_args()
    os.makedirs(args.model_path, exist_ok=True)
    logger = logging.getLogger("trainer")
    logger.addHandler(logging.FileHandler(os.path.join(args.model_path, "outputs.log")))
    logger.setLevel("INFO")
    safe_state(args.quiet)
    training(args, model_flags.extract(args), step_flags.extract(args), pipe_flags.extract(args),
             args.save_iterations + [args.iterations], logger)
    render_sets(args, model_flags.extract(args), -1, pipe_flags.extract(args), logger=logger)
