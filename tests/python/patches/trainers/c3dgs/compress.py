import os
from argparse import ArgumentParser, Namespace

import torch

from arguments import CompressionParams, ModelParams, OptimizationParams, PipelineParams, get_combined_args
from compression.vq import Codebook, compress
from finetune import finetune
from gaussian_renderer import GaussianModel, render
from scene import Scene
from utils.general_utils import safe_state
from utils.image_utils import psnr
from utils.loops import background_of, write_cfg_args


def sensitivity(gaussians, views, pipe):
    """How much the pictures change with every colour [N, K * 3] and with every covariance [N, 6]."""
    shapes = gaussians.get_normalized_covariance().detach().requires_grad_(True)
    factors = gaussians.get_scaling_factor.detach()
    inputs = (gaussians._features_dc, gaussians._features_rest, shapes)
    sums = [torch.zeros_like(tensor) for tensor in inputs]
    for view in views:
        black = torch.zeros(3, device=shapes.device)
        cov3d = shapes * factors ** 2
        image = render(view, gaussians, pipe, black, clamp_color=False, cov3d=cov3d)["render"]
        for total, gradient in zip(sums, torch.autograd.grad(image.sum(), inputs)):
            total += gradient.abs() / image[0].numel()
    return torch.cat(sums[:2], dim=1).flatten(1), sums[2]


def psnr_of(gaussians, views, pipe, fixed):
    with torch.no_grad():
        return [psnr(render(view, gaussians, pipe, fixed)["render"], view.original_image).item() for view in views]


def run_vq(model_params: ModelParams, rates: OptimizationParams, pipeline_params: PipelineParams,
           books: CompressionParams):
    fixed = background_of(model_params)
    model = GaussianModel(model_params.sh_degree, quantization=not rates.not_quantization_aware)
    world = Scene(model_params, model, load_iteration=books.load_iteration, shuffle=True)

    of_colors, of_shapes = sensitivity(model, world.getTrainCameras(), pipeline_params)
    with torch.no_grad():
        compress(model, of_colors.amax(-1), of_shapes.amax(-1),
                 Codebook(books.color_codebook_size, books.color_importance_include, books.color_cluster_iterations),
                 Codebook(books.gaussian_codebook_size, books.gaussian_importance_include,
                          books.gaussian_cluster_iterations),
                 books.prune_threshold)
    print(f"{len(model.get_xyz)} Gaussians, {len(model._features_dc)} colours, {len(model._scaling)} shapes")

    write_cfg_args(books.output_vq, Namespace(**{**vars(model_params), "model_path": books.output_vq}))
    finetune(world, books.finetune_iterations, rates, pipeline_params, fixed)
    last = world.loaded_iter + books.finetune_iterations
    folder = os.path.join(books.output_vq, "point_cloud", f"iteration_{last}")
    os.makedirs(folder, exist_ok=True)
    model.save_npz(os.path.join(folder, "point_cloud.npz"))
    print("PSNR", *(f"{value:.9g}" for value in psnr_of(model, world.getTestCameras(), pipeline_params, fixed)))


if __name__ == "__main__":
    flags = ArgumentParser(description="Puts a trained model into codebooks.")
    model_flags, pipe_flags = ModelParams(flags, sentinel=True), PipelineParams(flags)
    step_flags, book_flags = OptimizationParams(flags), CompressionParams(flags)
    args = get_combined_args(flags)

    safe_state(True)
    run_vq(model_flags.extract(args), step_flags.extract(args), pipe_flags.extract(args), book_flags.extract(args))
