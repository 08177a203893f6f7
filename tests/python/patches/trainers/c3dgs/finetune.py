import torch
from tqdm import tqdm

from gaussian_renderer import render
from scene import Scene
from utils.loops import background_of, endlessly, write_cfg_args
from utils.loss_utils import l1_loss, ssim


def finetune(scene: Scene, dataset, opt, comp, pipe, testing_iterations, debug_from):
    prepare_output_and_logger(comp.output_vq, dataset)
    model, fixed = scene.gaussians, background_of(dataset)
    model.training_setup(opt)
    views = endlessly(scene.getTrainCameras())
    for step in tqdm(range(comp.finetune_iterations)):
        view = next(views)
        image, target = render(view, model, pipe, fixed)["render"], view.original_image
        loss = torch.lerp(l1_loss(image, target), 1 - ssim(image, target), opt.lambda_dssim)
        loss.backward()
        print(f"step {step}: loss {loss.item():.9g}")
        model.optimizer.step()
        model.optimizer.zero_grad()


def prepare_output_and_logger(output_folder, args):
    write_cfg_args(output_folder, args)
