import os
import uuid
from argparse import ArgumentParser

import torch
from tqdm import tqdm

from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import network_gui, render
from scene import GaussianModel, Scene
from utils.flags import TRAINING, add_flags
from utils.general_utils import safe_state
from utils.image_utils import psnr
from utils.loops import background_of, endlessly, write_cfg_args
from utils.loss_utils import l1_loss, ssim


def training(dataset, opt, pipe, testing_iterations, saving_iterations, checkpoint_iterations, checkpoint, debug_from):
    make_output_folder(dataset)
    model = GaussianModel(dataset.sh_degree)
    world = Scene(dataset, model)
    model.training_setup(opt)

    fixed = background_of(dataset)
    views = endlessly(world.getTrainCameras())
    for step in tqdm(range(1, opt.iterations + 1)):
        if network_gui.conn is not None:
            wanted, zoom = network_gui.receive()
            network_gui.send(render(wanted, model, pipe, fixed, zoom)["render"], dataset.source_path)
        model.update_learning_rate(step)
        if step % 3 == 0:
            model.oneupSHdegree()
        pipe.debug = pipe.debug or step == debug_from

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
            if step < opt.densify_until_iter:
                densify(model, result, opt, step, world.cameras_extent)
            if step < opt.iterations:
                model.optimizer.step()
                model.optimizer.zero_grad()


def densify(model, result, opt, step, extent):
    seen, radii = result["visibility_filter"], result["radii"]
    model.max_radii2D[seen] = torch.maximum(model.max_radii2D[seen], radii[seen].float())
    model.add_densification_stats(result["viewspace_points"], seen)
    if opt.densify_from_iter < step and step % opt.densification_interval == 0:
        largest = 20 if opt.opacity_reset_interval < step else None
        model.densify_and_prune(opt.densify_grad_threshold, 0.005, extent, largest)
    if step % opt.opacity_reset_interval == 0:
        model.reset_opacity()


def make_output_folder(args):
    args.model_path = args.model_path or os.path.join("output", uuid.uuid4().hex[:10])
    write_cfg_args(args.model_path, args)


def training_report(step, testing_iterations, world: Scene, renderFunc, renderArgs):
    for view in world.getTestCameras() if step in testing_iterations else ():
        image = renderFunc(view, world.gaussians, *renderArgs)["render"].clamp(0, 1)
        print(f"step {step}: PSNR {psnr(image, view.original_image).item():.9g}")


if __name__ == "__main__":
    flags = ArgumentParser(description="Trains a few hundred Gaussians for a few steps.")
    model_flags, step_flags, pipe_flags = ModelParams(flags), OptimizationParams(flags), PipelineParams(flags)
    add_flags(flags, **TRAINING)
    args = flags.parse_args()

    safe_state(args.quiet)
    network_gui.init(host=args.ip, port=args.port)
    training(model_flags.extract(args), step_flags.extract(args), pipe_flags.extract(args), args.test_iterations,
             args.save_iterations + [args.iterations], args.checkpoint_iterations, args.start_checkpoint,
             args.debug_from)
