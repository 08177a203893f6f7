import os
import sys
import uuid
from argparse import ArgumentParser

import torch
from tqdm import tqdm

from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import network_gui, render
from scene import GaussianModel, Scene
from utils.flags import TRAINING, add_flags
from utils.general_utils import get_expon_lr_func, safe_state
from utils.image_utils import psnr
from utils.loops import background_of, endlessly, write_cfg_args
from utils.loss_utils import l1_loss, ssim

try:
    from fused_ssim import fused_ssim
    HAS_FUSED_SSIM = True
except ImportError:
    HAS_FUSED_SSIM = False

try:
    from diff_gaussian_rasterization import SparseGaussianAdam
    HAS_SPARSE_ADAM = True
except ImportError:
    HAS_SPARSE_ADAM = False


def training(dataset, opt, pipe, testing_iterations, saving_iterations, checkpoint_iterations, checkpoint, debug_from):

    if opt.optimizer_type == "sparse_adam" and not HAS_SPARSE_ADAM:
        sys.exit("this rasterizer brings no sparse Adam")

    make_output_folder(dataset)
    model = GaussianModel(dataset.sh_degree, opt.optimizer_type)
    world = Scene(dataset, model)
    model.training_setup(opt, [view.image_name for view in world.getTrainCameras()])

    fixed = background_of(dataset)
    depth_weight = get_expon_lr_func(opt.depth_l1_weight_init, opt.depth_l1_weight_final, opt.iterations)
    views = endlessly(world.getTrainCameras())
    for step in tqdm(range(1, opt.iterations + 1)):
        if network_gui.conn is not None:
            wanted, zoom = network_gui.receive()
            picture = render(wanted, model, pipe, fixed, scaling_modifier=zoom, separate_sh=HAS_SPARSE_ADAM,
                             use_trained_exp=dataset.train_test_exp)
            network_gui.send(picture["render"], dataset.source_path)
        model.update_learning_rate(step)
        if step % 3 == 0:
            model.oneupSHdegree()
        pipe.debug = pipe.debug or step == debug_from

        view = next(views)
        result = render(view, model, pipe, torch.rand_like(fixed) if opt.random_background else fixed,
                        use_trained_exp=dataset.train_test_exp, separate_sh=HAS_SPARSE_ADAM)
        image, target = result["render"], view.original_image
        similarity = fused_ssim(image[None], target[None]) if HAS_FUSED_SSIM else ssim(image, target)
        depth_loss = ((result["depth"] - view.invdepthmap) * view.depth_mask).abs().mean()
        loss = torch.lerp(l1_loss(image, target), 1 - similarity, opt.lambda_dssim) + depth_weight(step) * depth_loss
        loss.backward()
        print(f"step {step}: loss {loss.item():.9g}")

        with torch.no_grad():
            training_report(step, testing_iterations, world, render,
                            (pipe, fixed, 1.0, HAS_SPARSE_ADAM, None, dataset.train_test_exp))
            if step in saving_iterations:
                world.save(step)
            visible = result["radii"] > 0
            if opt.optimizer_type == "sparse_adam":
                model.optimizer.step(visible, len(visible))
            else:
                model.optimizer.step()
            model.exposure_optimizer.step()
            model.exposure_optimizer.zero_grad()
            model.optimizer.zero_grad()
            if step < opt.densify_until_iter:
                densify(model, result, opt, step, world.cameras_extent)


def densify(model, result, opt, step, extent):
    seen, radii = result["visibility_filter"], result["radii"]
    model.max_radii2D[seen] = torch.maximum(model.max_radii2D[seen], radii[seen].float())
    model.add_densification_stats(result["viewspace_points"], seen)
    if opt.densify_from_iter < step and step % opt.densification_interval == 0:
        largest = 20 if opt.opacity_reset_interval < step else None
        model.densify_and_prune(opt.densify_grad_threshold, 0.005, extent, largest, radii)
    if step % opt.opacity_reset_interval == 0:
        model.reset_opacity()


def make_output_folder(args):
    args.model_path = args.model_path or os.path.join("output", uuid.uuid4().hex[:10])
    write_cfg_args(args.model_path, args)


def training_report(step, testing_iterations, world: Scene, renderFunc, renderArgs):
    for view in world.getTestCameras() if step in testing_iterations else ():
        image = renderFunc(view, world.gaussians, *renderArgs)["render"]
        print(f"step {step}: PSNR {psnr(image, view.original_image).item():.9g}")


if __name__ == "__main__":
    flags = ArgumentParser(description="Trains a few hundred Gaussians for a few steps.")
    model_flags, step_flags, pipe_flags = ModelParams(flags), OptimizationParams(flags), PipelineParams(flags)
    add_flags(flags, disable_viewer=False, **TRAINING)
    args = flags.parse_args()

    safe_state(args.quiet)
    if not args.disable_viewer:
        network_gui.init(host=args.ip, port=args.port)
    training(model_flags.extract(args), step_flags.extract(args), pipe_flags.extract(args), args.test_iterations,
             args.save_iterations + [args.iterations], args.checkpoint_iterations, args.start_checkpoint,
             args.debug_from)
