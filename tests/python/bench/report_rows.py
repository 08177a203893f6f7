"""Made-up rows of a benchmark, with figures that are easy to work out by hand, and flat images to go with them."""
import json

from PIL import Image

from dsmoe.bench.names import blend_of

PROTOCOL = {"split": "sorted by name, every 8th is a test image", "resolution": -1, "image_size": [48, 32],
            "downscaler": "pillow bicubic", "background": "black", "principal_point": "scene",
            "psnr": "8-bit images, mean over test views", "sh_degree": 3, "train_views": 9, "test_views": 2,
            "scale_recipe": False, "recipe": {"lambda_dssim": 0.2, "feature_lr": 0.0025, "opacity_lr": 0.025}}
TRUTH, ALPHA, SMOE = (100, 100, 100), (180, 100, 100), (100, 100, 160)


def row(scene="bonsai", blend_mode="alpha", threshold=0.005, seed=0, psnr=20.0, **changes):
    """A row that succeeded; changes replace or add fields."""
    fields = {"suite": "table1", "ok": True, "reason": None, "method": "native", "variant": "native",
              "blend_mode": blend_mode, "schedule": "3dgs", "densify_grad_threshold": threshold, "scene": scene,
              "seed": seed, "iterations": 30000, "psnr": psnr, "psnr_float": psnr, "ssim": 0.75,
              "lpips": {"value": 0.25, "kind": "lpips_alex", "reason": None},
              "psnr_edge": None if psnr is None else psnr - 2,
              "num_gaussians": 40000, "size_bytes": {"own": 2_000_000, "common": 9_440_000}, "train_seconds": 100.0,
              "wall_seconds": 120.0, "fps": 200.0, "peak_gpu_mib": None, "protocol": dict(PROTOCOL),
              "commit": {"project": "abc1234", "trainer": None}, "machine": {"device": "Card X"}, "history": []}
    fields.update(changes)
    parts = ("suite", "method", "scene", "blend", "schedule", "densify_grad_threshold", "seed")
    named = {**fields, "blend": blend_of(fields)}
    return {"cell": "-".join(str(named[part]) for part in parts), **fields}


def failed(reason="out of memory", **changes):
    """A row of a cell that failed."""
    empty = dict.fromkeys(("psnr", "psnr_float", "ssim", "psnr_edge", "num_gaussians", "train_seconds",
                           "wall_seconds", "fps", "peak_gpu_mib"))
    return row(**{**changes, **empty, "ok": False, "reason": reason, "size_bytes": {"own": None, "common": None},
                  "lpips": {"value": None, "kind": "lpips_alex", "reason": "the cell failed"}})


def write_rows(folder, rows):
    """RESULTS/rows.jsonl."""
    folder.mkdir(parents=True, exist_ok=True)
    text = "".join(json.dumps(entry) + "\n" for entry in rows)
    (folder / "rows.jsonl").write_text(text, encoding="utf-8")
    return str(folder)


def write_images(folder, entry, color, names=("one", "two"), size=(48, 32), truth=TRUTH):
    """RESULTS/cells/CELL/images: a flat truth and a flat rendering for each name."""
    for kind, flat in (("gt", truth), ("render", color)):
        place = folder / "cells" / entry["cell"] / "images" / kind
        place.mkdir(parents=True, exist_ok=True)
        for name in names:
            Image.new("RGB", size, flat).save(place / f"{name}.png")
