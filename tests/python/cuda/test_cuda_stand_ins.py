"""Stand-ins in plain torch that trainers get on a GPU: on CUDA the results that they have on the CPU."""
from __future__ import annotations

from functools import partial

import torch

from diff_smoe_rasterization import fused_ssim
from diff_smoe_rasterization.integrations import weighted_distance
from diff_smoe_rasterization.integrations.torch_scatter import scatter, scatter_max
from dsmoe.patches import fuse, modernise


def test_the_nearest_row_of_a_codebook(gpu, monkeypatch):
    """In parts, with a row of the codebook far from all others."""
    monkeypatch.setattr(weighted_distance, "DISTANCES_AT_ONCE", 2 ** 18)
    torch.manual_seed(0)
    coefs, codebook = torch.randint(0, 64, (2000, 6)).float(), torch.randint(0, 64, (512, 6)).float()
    codebook[3] = 1e6
    distances, indices = weighted_distance.weightedDistance(coefs.to(gpu), codebook.to(gpu))
    every = (coefs.double()[:, None] - codebook.double()).square().sum(2)
    # Whole numbers: distances are exact, and those that differ do so by 1, which no product here is wrong by.
    assert torch.equal(distances.cpu().double(), every.min(1).values)
    assert torch.equal(every.gather(1, indices.cpu()[:, None])[:, 0], every.min(1).values)


def test_distinct_rows(gpu):
    unique_rows = partial(modernise.unique_rows, torch.unique)
    torch.manual_seed(0)
    for low, high in ((-3, 3), (-90, 90), (-2 ** 31, 2 ** 31 - 1)):
        cells = torch.randint(low, high, (20_000, 3), dtype=torch.int32)
        expected = torch.unique(cells, dim=0, return_inverse=True, return_counts=True)
        for ours, torchs in zip(unique_rows(cells.to(gpu), return_inverse=True, return_counts=True, dim=0), expected):
            assert ours.dtype == torchs.dtype and torch.equal(ours.cpu(), torchs)


def test_sums_and_maxima_of_groups(gpu):
    torch.manual_seed(0)
    values, index = torch.randint(-100, 100, (5000, 4)).float(), torch.randint(0, 300, (5000,))
    # Sums of integers are exact in any order.
    assert torch.equal(scatter(values.to(gpu), index.to(gpu), 0, dim_size=310).cpu(),
                       scatter(values, index, 0, dim_size=310))
    for ours, expected in zip(scatter_max(values.to(gpu), index.to(gpu), 0, dim_size=310),
                              scatter_max(values, index, 0, dim_size=310)):
        assert torch.equal(ours.cpu(), expected)


def test_ssim_is_fused_on_the_device_of_its_images(gpu, capsys):
    """The trainer's own is the CPU's kernel here, which the reference tests hold to the equation. It is asked once."""
    called = []

    def of_the_trainer(img1, img2, window_size=11, size_average=True):
        called.append(img1.shape)
        return fused_ssim(img1.cpu(), img2.cpu()).to(img1.device)

    call = partial(fuse.fused_where_equal, of_the_trainer, {})
    torch.manual_seed(0)
    image, target = torch.rand(2, 3, 70, 50, device=gpu)
    value = call(image.requires_grad_(), target)
    value.backward()
    assert image.grad.abs().max() > 0 and called == [(3, 70, 50)] and capsys.readouterr().err == ""
    assert abs(value.item() - fused_ssim(image.detach().cpu(), target.cpu()).item()) < 1e-5  # rounding of float32
