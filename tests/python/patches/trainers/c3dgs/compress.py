import os
from argparse import ArgumentParser
from shutil import copyfile

import torch

from arguments import CompressionParams, ModelParams, OptimizationParams, PipelineParams, get_combined_args
from compression.vq import CompressionSettings, compress_gaussians
from finetune import finetune
from gaussian_renderer import GaussianModel, render
from scene import Scene
from utils.general_utils import safe_state
from utils.image_utils import psnr
from utils.loops import background_of


def calc_importance(gaussians: GaussianModel, scene, pipeline_params):
    """How much the pictures change with every colour [N, K * 3] and with every covariance [N, 6]."""
    shapes = gaussians.get_normalized_covariance().detach().requires_grad_(True)
    factors = gaussians.get_scaling_factor.detach()
    inputs = (gaussians._features_dc, gaussians._features_rest, shapes)
    sums = [torch.zeros_like(tensor) for tensor in inputs]
    for view in scene.getTrainCameras():
        black = torch.zeros(3, device=shapes.device)
        cov3d = shapes * factors ** 2
        image = render(view, gaussians, pipeline_params, black, clamp_color=False, cov3d=cov3d)["render"]
        for total, gradient in zip(sums, torch.autograd.grad(image.sum(), inputs)):
            total += gradient.abs() / image[0].numel()
    return torch.cat(sums[:2], dim=1).flatten(1), sums[2]


def render_and_eval(gaussians: GaussianModel, scene: Scene, model_params: ModelParams, pipeline_params: PipelineParams):
    fixed = background_of(model_params)
    with torch.no_grad():
        return [psnr(render(view, gaussians, pipeline_params, fixed)["render"], view.original_image).item()
                for view in scene.getTestCameras()]


def run_vq(
    model_params: ModelParams,
    optim_params: OptimizationParams,
    pipeline_params: PipelineParams,
    comp_params: CompressionParams,
):
    model = GaussianModel(model_params.sh_degree, quantization=not optim_params.not_quantization_aware)
    world = Scene(model_params, model, load_iteration=comp_params.load_iteration, shuffle=True)

    color_importance, gaussian_sensitivity = calc_importance(model, world, pipeline_params)
    with torch.no_grad():
        compress_gaussians(
            model, color_importance.amax(-1), gaussian_sensitivity.amax(-1),
            CompressionSettings(comp_params.color_codebook_size, comp_params.color_importance_include,
                                comp_params.color_cluster_iterations),
            CompressionSettings(comp_params.gaussian_codebook_size, comp_params.gaussian_importance_include,
                                comp_params.gaussian_cluster_iterations),
            comp_params.prune_threshold)
    print(f"{len(model.get_xyz)} Gaussians, {len(model._features_dc)} colours, {len(model._scaling)} shapes")

    last = world.loaded_iter + comp_params.finetune_iterations
    folder = os.path.join(comp_params.output_vq, "point_cloud", f"iteration_{last}")
    os.makedirs(folder, exist_ok=True)
    copyfile(os.path.join(model_params.model_path, "cfg_args"), os.path.join(comp_params.output_vq, "cfg_args"))
    model_params.model_path = comp_params.output_vq
    if comp_params.finetune_iterations > 0:
        finetune(world, model_params, optim_params, comp_params, pipeline_params, testing_iterations=[-1],
                 debug_from=-1)
    model.save_npz(os.path.join(folder, "point_cloud.npz"))
    print("PSNR", *(f"{value:.9g}" for value in render_and_eval(model, world, model_params, pipeline_params)))


if __name__ == "__main__":
    flags = ArgumentParser(description="Puts a trained model into codebooks.")
    model_flags, pipe_flags = ModelParams(flags, sentinel=True), PipelineParams(flags)
    step_flags, book_flags = OptimizationParams(flags), CompressionParams(flags)
    args = get_combined_args(flags)

    safe_state(True)
    run_vq(model_flags.extract(args), step_flags.extract(args), pipe_flags.extract(args), book_flags.extract(args))
