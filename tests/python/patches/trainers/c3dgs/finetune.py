import torch
from tqdm import tqdm

from gaussian_renderer import render
from utils.loops import endlessly
from utils.loss_utils import l1_loss, ssim


def finetune(world, steps, rates, pipe, fixed):
    """Trains what the codebooks hold for that many steps."""
    model, views = world.gaussians, endlessly(world.getTrainCameras())
    model.training_setup(rates)
    for step in tqdm(range(steps)):
        view = next(views)
        image, target = render(view, model, pipe, fixed)["render"], view.original_image
        loss = torch.lerp(l1_loss(image, target), 1 - ssim(image, target), rates.lambda_dssim)
        loss.backward()
        print(f"step {step}: loss {loss.item():.9g}")
        model.optimizer.step()
        model.optimizer.zero_grad()
