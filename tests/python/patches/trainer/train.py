import os
from argparse import ArgumentParser, Namespace

import torch
from tqdm import tqdm

from arguments import ModelParams, OptimizationParams, PipelineParams, training_flags
from gaussian_renderer import render
from scene import GaussianModel, Scene
from utils.general_utils import background_of, endlessly, psnr, safe_state
from utils.loss_utils import l1_loss, ssim


def training(dataset, opt, pipe, testing_iterations, saving_iterations, checkpoint_iterations, checkpoint, debug_from):
    write_cfg_args(dataset)
    model = GaussianModel(dataset.sh_degree)
    world = Scene(dataset, model)
    model.training_setup(opt)
    fixed = background_of(dataset)
    views = endlessly(world.getTrainCameras())
    for step in tqdm(range(1, opt.iterations + 1)):
        if step == 3:
            model.oneupSHdegree()
        view = next(views)
        result = render(view, model, pipe, torch.rand_like(fixed) if opt.random_background else fixed)
        image, target = result["render"], view.original_image
        loss = torch.lerp(l1_loss(image, target), 1 - ssim(image, target), opt.lambda_dssim)
        loss.backward()
        print(f"step {step}: loss {loss.item():.9g}")

        with torch.no_grad():
            training_report(step, testing_iterations, world, render, (pipe, fixed))
            if step in saving_iterations:
                world.save(step)
            model.optimizer.step()
            model.optimizer.zero_grad()
            if step % opt.densification_interval == 0 and step < 6:
                model.densify_and_prune(result["viewspace_points"], opt.densify_grad_threshold)


def write_cfg_args(args):
    os.makedirs(args.model_path, exist_ok=True)
    with open(os.path.join(args.model_path, "cfg_args"), "w") as file:
        file.write(repr(Namespace(**vars(args))))


def training_report(step, testing_iterations, world: Scene, renderFunc, renderArgs):
    for view in world.getTestCameras() if step in testing_iterations else ():
        image = renderFunc(view, world.gaussians, *renderArgs)["render"].clamp(0, 1)
        print(f"step {step}: PSNR {psnr(image, view.original_image).item():.9g}")


if __name__ == "__main__":
    flags = ArgumentParser(description="Trains a few hundred Gaussians for a few steps.")
    model_flags, step_flags, pipe_flags = ModelParams(flags), OptimizationParams(flags), PipelineParams(flags)
    training_flags(flags)
    args = flags.parse_args()
    safe_state(args.quiet)
    training(model_flags.extract(args), step_flags.extract(args), pipe_flags.extract(args), args.test_iterations,
             args.save_iterations + [args.iterations], args.checkpoint_iterations, args.start_checkpoint,
             args.debug_from)
