"""Side-by-side pictures: ground truth and renderings, labelled, with one magnified window."""
from __future__ import annotations

import os
from typing import Any, List, Sequence, Tuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..errors import printable

MARGIN = 6  # pixels between pictures
LABEL_SHARE = 25  # a label is this part of a picture's width high
WINDOW_SHARE = 4  # a window is this part of the picture's width and height, and magnified as much
MIN_WIDTH = 400  # of each picture; smaller ones are enlarged by a whole factor
FRAME = (255, 60, 0)


def file_names(camera_names: Sequence[str]) -> List[str]:
    """A file name without extension for each camera: folders joined by "_", equal ones numbered, printable."""
    names: List[str] = []
    for camera_name in camera_names:
        stem = printable(os.path.splitext(camera_name)[0]).replace("/", "_").replace(os.sep, "_")
        name, number = stem, 1
        while name in names:
            number += 1
            name = f"{stem}_{number}"
        names.append(name)
    return names


def comparison(truth: Image.Image, renderings: Sequence[Tuple[str, Image.Image]]) -> Image.Image:
    """One row of whole pictures, and under it the same window of each, magnified. All images have one size.

    The window is where the first rendering and the last one differ most.
    """
    window = window_of_differences(renderings[0][1], renderings[-1][1])
    columns = [("ground truth", truth), *renderings]
    factor = max(1, -(-MIN_WIDTH // truth.width))
    width, height = truth.width * factor, truth.height * factor
    font_size = width // LABEL_SHARE
    label_height = font_size * 3 // 2
    sheet = Image.new("RGB", (len(columns) * (width + MARGIN) + MARGIN,
                              label_height + 2 * (height + MARGIN)), (255, 255, 255))
    draw, font = ImageDraw.Draw(sheet), _font(font_size)
    for index, (label, image) in enumerate(columns):
        left = MARGIN + index * (width + MARGIN)
        draw.text((left, font_size // 8), label, fill=(0, 0, 0), font=font)
        whole = image.resize((width, height), Image.NEAREST)
        ImageDraw.Draw(whole).rectangle([value * factor for value in window], outline=FRAME, width=1 + width // 400)
        sheet.paste(whole, (left, label_height))
        part = image.crop(window).resize((width, height), Image.NEAREST)
        sheet.paste(part, (left, label_height + height + MARGIN))
    return sheet


def _font(size: int) -> Any:
    """Pillow's font, so many pixels high; before Pillow 10.1 it has one size, about 11."""
    try:
        return ImageFont.load_default(size)
    except TypeError:
        return ImageFont.load_default()


def loss_plot(losses: Sequence[Tuple[int, float]]) -> Image.Image:
    """The loss, upward, over the iterations: pairs of both, in order."""
    width, height, edge = 640, 320, 40
    picture = Image.new("RGB", (width, height), (255, 255, 255))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default()
    last, top = losses[-1][0], max(loss for _, loss in losses) or 1.0
    for share in (0.0, 0.5, 1.0):
        y, x = height - edge - share * (height - 2 * edge), edge + share * (width - 2 * edge)
        draw.line([(edge, y), (width - edge, y)], fill=(220, 220, 220))
        draw.text((4, y - 6), f"{share * top:.3f}", fill=(0, 0, 0), font=font)
        draw.text((x - 12, height - edge + 6), f"{share * last:.0f}", fill=(0, 0, 0), font=font)
    draw.line([(edge + iteration / last * (width - 2 * edge), height - edge - loss / top * (height - 2 * edge))
               for iteration, loss in losses], fill=(0, 114, 178))
    draw.text((width // 2 - 60, 12), "loss over iterations", fill=(0, 0, 0), font=font)
    return picture


def window_of_differences(one: Image.Image, other: Image.Image) -> Tuple[int, int, int, int]:
    """(left, top, right, bottom) of the window in which two images of one size differ most, by the absolute sum."""
    differences = np.abs(np.asarray(one, np.float64) - np.asarray(other, np.float64)).sum(axis=2)
    height, width = (max(1, size // WINDOW_SHARE) for size in differences.shape)
    sums = np.pad(differences, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    inside = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(left), int(top), int(left) + width, int(top) + height


def evenly_spaced(count: int, wanted: int) -> List[int]:
    """Up to `wanted` indices below `count`, spread evenly."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, wanted))}) if count else []
