import logging
import os
import uuid
from argparse import ArgumentParser

import torch
from tqdm import tqdm

from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import network_gui, prefilter_voxel, render
from scene import GaussianModel, Scene
from utils.encodings import mask_bits
from utils.flags import TRAINING, add_flags
from utils.general_utils import safe_state
from utils.image_utils import psnr, save_image
from utils.loops import background_of, endlessly, write_cfg_args
from utils.loss_utils import l1_loss, ssim

run_codec = True


def training(args_param, dataset, opt, pipe, dataset_name, testing_iterations, saving_iterations,
             checkpoint_iterations, checkpoint, debug_from, wandb=None, logger=None, ply_path=None):
    make_output_folder(dataset)
    model = GaussianModel(dataset)
    world = Scene(dataset, model, ply_path=ply_path)
    model.training_setup(opt)

    fixed = background_of(dataset)
    views = endlessly(world.getTrainCameras())
    for step in tqdm(range(1, opt.iterations + 1)):
        if network_gui.conn is not None:
            wanted, zoom = network_gui.receive()
            network_gui.send(render(wanted, model, pipe, fixed, zoom)["render"], dataset.source_path)
        pipe.debug = pipe.debug or step == debug_from

        view = next(views)
        visible = prefilter_voxel(view, model, pipe, fixed)
        result = render(view, model, pipe, fixed, visible_mask=visible, step=step)
        image, target = result["render"], view.original_image
        loss = torch.lerp(l1_loss(image, target), 1 - ssim(image, target), opt.lambda_dssim)
        loss = loss + 0.01 * result["scaling"].prod(dim=1).mean() + args_param.lmbda * model._mask.sigmoid().mean()
        loss.backward()
        logger.info(f"step {step}: loss {loss.item():.9g}, {int(visible.sum())} of {len(visible)} anchors")

        with torch.no_grad():
            training_report(None, dataset_name, step, testing_iterations, world, render, (pipe, fixed), wandb, logger)
            if step in saving_iterations:
                world.save(step)
            model.optimizer.step()
            model.optimizer.zero_grad()
            if opt.start_stat < step < opt.update_until:
                model.training_statis(result["viewspace_points"], result["neural_opacity"],
                                      result["visibility_filter"], result["selection_mask"], visible)
                if step > opt.update_from and step % opt.update_interval == 0:
                    model.adjust_anchor(check_interval=opt.update_interval, success_threshold=opt.success_threshold,
                                        grad_threshold=opt.densify_grad_threshold, min_opacity=opt.min_opacity)


def make_output_folder(args):
    args.model_path = args.model_path or os.path.join("output", uuid.uuid4().hex[:10])
    write_cfg_args(args.model_path, args)


def training_report(tb_writer, dataset_name, step, testing_iterations, world: Scene, renderFunc, renderArgs,
                    wandb=None, logger=None):
    if step not in testing_iterations:
        return
    world.gaussians.eval()
    logger.info(f"masks: {mask_bits(world.gaussians.get_mask)[1]:.9g} bits")
    for view in world.getTestCameras():
        visible = prefilter_voxel(view, world.gaussians, *renderArgs)
        image = renderFunc(view, world.gaussians, *renderArgs, visible_mask=visible)["render"].clamp(0, 1)
        logger.info(f"step {step}: PSNR {psnr(image, view.original_image).item():.9g}")
    world.gaussians.train()


def save_pictures(output, views, gaussians, pipeline, background):
    folder = os.path.join(output, "renders")
    for index, view in enumerate(views):
        visible = prefilter_voxel(view, gaussians, pipeline, background)
        image = render(view, gaussians, pipeline, background, visible_mask=visible)["render"]
        save_image(image, os.path.join(folder, f"{index:05d}.png"))


def render_sets(args_param, dataset: ModelParams, iteration: int, pipeline: PipelineParams, skip_train=True,
                skip_test=False, wandb=None, tb_writer=None, dataset_name=None, logger=None):
    with torch.no_grad():
        model = GaussianModel(dataset, decoded=run_codec)
        world = Scene(dataset, model, load_iteration=iteration, shuffle=False)
        model.eval()
        if not skip_test:
            output = os.path.join(dataset.model_path, "test", f"ours_{world.loaded_iter}")
            save_pictures(output, world.getTestCameras(), model, pipeline, background_of(dataset))


def log_of(folder):
    os.makedirs(folder, exist_ok=True)
    made = logging.getLogger("trainer")
    made.addHandler(logging.FileHandler(os.path.join(folder, "outputs.log")))
    made.setLevel("INFO")
    return made


if __name__ == "__main__":
    flags = ArgumentParser(description="Trains anchors and their networks for a few steps, and renders the result.")
    model_flags, step_flags, pipe_flags = ModelParams(flags), OptimizationParams(flags), PipelineParams(flags)
    add_flags(flags, warmup=False, lmbda=0.001, gpu="-1", **TRAINING)
    args = flags.parse_args()

    logger = log_of(args.model_path)
    experiment = args.model_path.split("/")[-2]
    logger.info(f"experiment {experiment}")

    safe_state(args.quiet)
    training(args, model_flags.extract(args), step_flags.extract(args), pipe_flags.extract(args), experiment,
             args.test_iterations, args.save_iterations + [args.iterations], args.checkpoint_iterations,
             args.start_checkpoint, args.debug_from, None, logger)
    render_sets(args, model_flags.extract(args), -1, pipe_flags.extract(args), logger=logger)
