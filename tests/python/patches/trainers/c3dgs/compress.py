import os
from argparse import ArgumentParser, Namespace

import torch
from tqdm import tqdm

from arguments import CompressionParams, ModelParams, OptimizationParams, PipelineParams, get_combined_args
from gaussian_renderer import GaussianModel, render
from scene import Scene
from utils.general_utils import background_of, build_covariance, endlessly, psnr, safe_state
from utils.loss_utils import l1_loss


def sensitivity(model, views, pipe):
    """[N]: how much the pictures change with every covariance."""
    cov3d = build_covariance(model.get_scaling, model.get_rotation).detach().requires_grad_(True)
    black = torch.zeros(3, device=cov3d.device)
    images = [render(view, model, pipe, black, clamp_color=False, cov3d=cov3d)["render"].sum() for view in views]
    return torch.autograd.grad(sum(images), cov3d)[0].abs().amax(1)


def run_vq(model_params: ModelParams, rates: OptimizationParams, pipeline_params: PipelineParams,
           books: CompressionParams):
    model = GaussianModel(model_params.sh_degree)
    world = Scene(model_params, model, load_iteration=books.load_iteration, shuffle=True)
    model.compress(sensitivity(model, world.getTrainCameras(), pipeline_params))
    model.training_setup(rates)

    fixed, views = background_of(model_params), endlessly(world.getTrainCameras())
    os.makedirs(books.output_vq, exist_ok=True)
    with open(os.path.join(books.output_vq, "cfg_args"), "w") as file:
        file.write(repr(Namespace(**{**vars(model_params), "model_path": books.output_vq})))
    for step in tqdm(range(books.finetune_iterations)):
        view = next(views)
        loss = l1_loss(render(view, model, pipeline_params, fixed)["render"], view.original_image)
        loss.backward()
        print(f"step {step}: loss {loss.item():.9g}")
        model.optimizer.step()
        model.optimizer.zero_grad()
    world.model_path = books.output_vq
    world.save(world.loaded_iter + books.finetune_iterations)
    with torch.no_grad():
        for view in world.getTestCameras():
            print(f"PSNR {psnr(render(view, model, pipeline_params, fixed)['render'], view.original_image).item():.9g}")


if __name__ == "__main__":
    flags = ArgumentParser(description="Puts a trained model into codebooks.")
    model_flags, pipe_flags = ModelParams(flags, sentinel=True), PipelineParams(flags)
    step_flags, book_flags = OptimizationParams(flags), CompressionParams(flags)
    args = get_combined_args(flags)
    safe_state(True)
    run_vq(model_flags.extract(args), step_flags.extract(args), pipe_flags.extract(args), book_flags.extract(args))
