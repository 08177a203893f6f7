import os
import random
import uuid
from argparse import ArgumentParser

import torch
from fused_ssim import fused_ssim as fast_ssim
from tqdm import tqdm

from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import network_gui_ws, render
from scene import GaussianModel, Scene
from utils.flags import TRAINING, add_flags
from utils.general_utils import safe_state
from utils.image_utils import psnr
from utils.loops import background_of, endlessly, write_cfg_args
from utils.loss_utils import l1_loss
from utils.taming_utils import compute_gaussian_score, get_count_array, get_edges, stretched


def training(dataset, opt, pipe, testing_iterations, saving_iterations, checkpoint_iterations, checkpoint, debug_from,
             websockets, score_coefficients, args):
    make_output_folder(dataset)
    model = GaussianModel(dataset.sh_degree, opt.optimizer_type)
    world = Scene(dataset, model)
    model.training_setup(opt)

    fixed = background_of(dataset)
    bg = torch.rand_like(fixed) if opt.random_background else fixed
    budgets = get_count_array(len(model.get_xyz), args.budget, opt, mode=args.mode)
    views = endlessly(world.getTrainCameras())
    for step in tqdm(range(1, opt.iterations + 1)):
        if websockets and network_gui_ws.curr_id >= 0:
            wanted = world.getTrainCameras()[network_gui_ws.curr_id]
            network_gui_ws.latest_result = render(wanted, model, pipe, fixed, 1.0)["render"]
        model.update_learning_rate(step)
        if step % 3 == 0:
            model.oneupSHdegree()
        pipe.debug = pipe.debug or step == debug_from

        view = next(views)
        result = render(view, model, pipe, bg)
        image, target = result["render"], view.original_image
        loss = torch.lerp(l1_loss(image, target), 1 - fast_ssim(image[None], target[None]), opt.lambda_dssim)
        loss.backward()
        print(f"step {step}: loss {loss.item():.9g}")

        with torch.no_grad():
            training_report(step, testing_iterations, world, render, (pipe, fixed))
            if step in saving_iterations:
                world.save(step)
            if opt.optimizer_type == "sparse_adam":
                model.optimizer.step(result["radii"] > 0, len(result["radii"]))
            for optimizer in model.optimizers:
                if opt.optimizer_type == "default" and not (args.sh_lower and optimizer is model.shoptimizer):
                    optimizer.step()
                optimizer.zero_grad()
            if step < opt.densify_until_iter:
                densify(world, model, result, opt, pipe, bg, step, args, score_coefficients, budgets)
            if step == args.ho_iteration:
                model.release_opacities()


def densify(world, model, result, opt, pipe, bg, step, args, score_coefficients, budgets):
    seen, radii = result["visibility_filter"], result["radii"]
    model.max_radii2D[seen] = torch.maximum(model.max_radii2D[seen], radii[seen].float())
    model.add_densification_stats(result["viewspace_points"], seen)
    if opt.densify_from_iter < step and step % opt.densification_interval == 0:
        chosen = random.sample(world.getTrainCameras(), args.cams)
        edges = [stretched(get_edges(view.original_image)) for view in chosen]
        scores = compute_gaussian_score(world, chosen, edges, model, pipe, bg, score_coefficients, opt)
        model.densify_with_score(scores=scores, max_screen_size=20 if opt.opacity_reset_interval < step else None,
                                 min_opacity=0.005, extent=world.cameras_extent, budget=budgets.pop(0), radii=radii,
                                 iter_num=step)
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
    add_flags(flags, cams=2, budget=3.0, mode="multiplier", websockets=False, ho_iteration=6, sh_lower=False,
              **TRAINING)
    args = flags.parse_args()

    safe_state(args.quiet)
    if args.websockets:
        network_gui_ws.init(host=args.ip, port=args.port)
    coefficients = dict(gradient=2.0, opacity=3.0, size=2.0, depth=0.5, radius=0.5, distance=4.0, weight=1.0, count=0.1,
                        blend=4.0, error=1.0, edges=1.0)
    training(model_flags.extract(args), step_flags.extract(args), pipe_flags.extract(args), args.test_iterations,
             args.save_iterations + [args.iterations], args.checkpoint_iterations, args.start_checkpoint,
             args.debug_from, args.websockets, coefficients, args)
