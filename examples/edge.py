"""A sharp edge by 2 and by 4 Gaussians, in alpha and in smoe: python examples/edge.py -o edge.png

Each blend trains its own Gaussians by the same steps of Adam, from the same start. smoe learns its background gate too.
With --rules 2 Gaussians do it by each rule of the paper as well, from narrow and from wide starts.
"""
import argparse
import math

import torch
from PIL import Image, ImageDraw, ImageFont

from diff_smoe_rasterization import rasterize, settings_from_camera

SIZE = 128  # pixels
K = [[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1]]
BORDER = 34  # above each row of images, for its text
RULES = {"alpha": {"blend_mode": "alpha"}, "smoe": {"blend_mode": "smoe", "background_gate": "learned"},
         "the authors' program": {"blend_mode": "smoe", "background_gate": 0.0, "faint_below": 2.0},
         "Eq. 7 as printed": {"blend_mode": "smoe_eq7", "background_gate": 0.0}}


def edge():
    """[3, H, W]: orange above the diagonal, blue below."""
    y, x = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    above = (x > y).float()
    return torch.stack([0.9 * above, torch.full_like(above, 0.25), 0.9 * (1 - above)])


def start(count, width):
    """Grey Gaussians, such a part of the picture wide: two on both sides of the edge, more at random places."""
    torch.manual_seed(0)
    places = torch.tensor([[0.15, -0.15], [-0.15, 0.15]]) if count == 2 else torch.rand(count, 2) - 0.5
    return {"means3D": torch.cat([places, torch.full((count, 1), 2.0)], dim=1), "colors": torch.full((count, 3), 0.5),
            "log_scales": torch.full((count, 3), math.log(2 * width)), "opacity_logits": torch.zeros(count, 1),
            "rotations": torch.tensor([1.0, 0.0, 0.0, 0.0]) + 0.01 * torch.randn(count, 4)}


def fit(target, count, rule, steps, width=0.25):
    """The image of so many Gaussians, trained on the target."""
    raw, log_gate = start(count, width), torch.tensor(-5.0)
    for tensor in (*raw.values(), log_gate):
        tensor.requires_grad_()
    adam = torch.optim.Adam([{"params": list(raw.values()), "lr": 0.01}, {"params": [log_gate], "lr": 0.01}])
    rates = torch.optim.lr_scheduler.ExponentialLR(adam, 0.1 ** (1 / steps))  # to a tenth
    for _ in range(steps):
        gate = log_gate.exp() if rule.get("background_gate") == "learned" else rule.get("background_gate")
        settings = settings_from_camera(K, torch.eye(3), torch.zeros(3), SIZE, SIZE,
                                        **{**rule, "background_gate": gate})
        image = rasterize(raw["means3D"], raw["opacity_logits"].sigmoid(), settings, colors_precomp=raw["colors"],
                          scales=raw["log_scales"].exp(),
                          rotations=torch.nn.functional.normalize(raw["rotations"])).color
        loss = (image - target).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        rates.step()
    return image.detach()


def decibels(image, target):
    """PSNR."""
    return -10 * math.log10((image - target).square().mean())


def panel(image):
    """[3, H, W] in [0, 1] as a picture of twice the size."""
    values = (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous().numpy()
    return Image.fromarray(values).resize((2 * SIZE, 2 * SIZE), Image.NEAREST)


def font():
    """Of a size that can be read, if Pillow has one (10.1)."""
    try:
        return ImageFont.load_default(20)
    except TypeError:
        return ImageFont.load_default()


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=600)
parser.add_argument("--rules", action="store_true", help="2 Gaussians by each rule, in place of the picture")
parser.add_argument("-o", "--output", default="edge.png")
arguments = parser.parse_args()

torch.set_num_threads(1)  # tensors are so small that threads would only wait for each other
target = edge()
if arguments.rules:
    for width in (0.25, 1.0):
        print(f"2 Gaussians that begin {width:g} of the picture wide")
        for name, rule in RULES.items():
            print(f"  {name}: {decibels(fit(target, 2, rule, arguments.steps, width), target):.1f} dB")
else:
    width, height, gap = 2 * SIZE, 2 * SIZE + BORDER, 12
    sheet = Image.new("RGB", (3 * width + 2 * gap, 2 * height), "white")
    draw = ImageDraw.Draw(sheet)
    for row, count in enumerate((2, 4)):
        images = {"the picture": target}
        for blend_mode in ("alpha", "smoe"):
            image = fit(target, count, RULES[blend_mode], arguments.steps)
            text = f"{blend_mode}, {count} Gaussians: {decibels(image, target):.1f} dB"
            print(text)
            images[text] = image
        for column, (text, image) in enumerate(images.items()):
            draw.text((column * (width + gap), row * height + 6), text, fill="black", font=font())
            sheet.paste(panel(image), (column * (width + gap), row * height + BORDER))
    sheet.save(arguments.output)
