from typing import NamedTuple

import torch


class Codebook(NamedTuple):
    size: int
    shared: float  # share of the rows that are looked up; the others, the most important ones, are kept as they are
    steps: int


def cluster(rows, importance, settings):
    """Codebook [K, D] and the row of it that stands for each of rows [N, D]: weighted k-means."""
    kept = importance.argsort(descending=True)[:int((1 - settings.shared) * len(rows))]
    others = torch.ones(len(rows), dtype=torch.bool, device=rows.device)
    others[kept] = False
    data, weights = rows[others], importance[others][:, None] + 1e-9
    book = data[torch.randperm(len(data))[:settings.size]].clone()
    for _ in range(settings.steps):
        nearest = torch.cdist(data, book).argmin(dim=1)
        total = torch.zeros(len(book), 1, device=rows.device).index_add_(0, nearest, weights)
        sums = torch.zeros_like(book).index_add_(0, nearest, weights * data)
        book = torch.where(total > 0, sums / total.clamp_min(1e-12), book)
    indices = torch.empty(len(rows), dtype=torch.int64, device=rows.device)
    indices[others] = torch.cdist(data, book).argmin(dim=1)
    indices[kept] = torch.arange(len(book), len(book) + len(kept), device=rows.device)
    return torch.cat([book, rows[kept]]), indices


def compress(gaussians, of_colors, of_shapes, colors: Codebook, shapes: Codebook, prune_threshold):
    """Drops what no view needs, and puts colours and shapes into codebooks."""
    needed = of_colors > prune_threshold
    gaussians.mask_splats(needed)
    features = torch.cat([gaussians._features_dc, gaussians._features_rest], dim=1)
    book, indices = cluster(features.flatten(1), of_colors[needed], colors)
    book = book.unflatten(1, (-1, 3))
    gaussians.set_color_indexed(book[:, :1], book[:, 1:], indices)
    axes = torch.cat([gaussians._rotation, gaussians._scaling], dim=1)
    book, indices = cluster(axes, of_shapes[needed], shapes)
    gaussians.set_gaussian_indexed(book[:, :4], book[:, 4:], indices)
