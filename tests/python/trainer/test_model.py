"""Initial Gaussians by hand, the learning rates of 3DGS, Adam's state, and .ply files."""
from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from diff_smoe_rasterization import io
from diff_smoe_rasterization.settings import GATED_MODES
from dsmoe.errors import TrainerError
from dsmoe.model import PARAMETERS, GaussianModel
from dsmoe.optimizer import GaussianOptimizer, exponential_rate
from dsmoe.options.config import TrainConfig
from dsmoe.results.modelfile import (
    Recorded,
    agreed_background_gate,
    agreed_blend_mode,
    load_model,
    save_model,
)
from dsmoe.scenes.pointcloud import PointCloud

TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])


@pytest.fixture
def points():
    return PointCloud(TETRAHEDRON, np.linspace(0, 1, 12).reshape(4, 3))


def random_model(count=10, sh_degree=3):
    generator = torch.Generator().manual_seed(0)
    shapes = {"means3D": (3,), "dc": (1, 3), "shs": ((sh_degree + 1) ** 2 - 1, 3), "opacities": (1,), "scales": (3,),
              "rotations": (4,)}
    raw = {name: torch.randn(count, *shape, generator=generator) for name, shape in shapes.items()}
    return GaussianModel(raw, sh_degree)


def test_scales_are_the_mean_squared_distance_to_three_neighbours(points):
    model = GaussianModel.from_points(points, 3, "cpu")
    # Squared distances from the origin: 1, 4, 9; from (1, 0, 0): 1, 5, 10.
    expected = [math.sqrt((1 + 4 + 9) / 3), math.sqrt((1 + 5 + 10) / 3)]
    for row, scale in enumerate(expected):
        np.testing.assert_allclose(model.scales[row].detach().numpy(), [scale] * 3, rtol=1e-6)  # float32


def test_coinciding_points_get_a_small_finite_scale():
    model = GaussianModel.from_points(PointCloud(np.zeros((5, 3)), np.zeros((5, 3))), 0, "cpu")
    np.testing.assert_allclose(model.scales.detach().numpy(), math.sqrt(1e-7), rtol=1e-6)  # float32


def test_initial_opacity_colour_and_rotation(points):
    model = GaussianModel.from_points(points, 2, "cpu")
    np.testing.assert_allclose(model.opacities.detach().numpy(), 0.1, rtol=1e-6)  # float32
    # The constant harmonic is 1 / (2 sqrt(pi)); 3DGS adds 0.5.
    colors = 0.5 + model.raw["dc"][:, 0].detach().numpy() / (2 * math.sqrt(math.pi))
    np.testing.assert_allclose(colors, points.colors, rtol=0, atol=1e-6)  # float32
    assert model.raw["shs"].shape == (4, 8, 3) and not model.raw["shs"].any()
    np.testing.assert_array_equal(model.rotations.detach().numpy(), [[1, 0, 0, 0]] * 4)


def test_position_rate_falls_log_linearly():
    first, last = 0.00016, 0.0000016
    assert exponential_rate(0, first, last, 30_000) == pytest.approx(first, rel=1e-12)
    assert exponential_rate(15_000, first, last, 30_000) == pytest.approx(math.sqrt(first * last), rel=1e-12)
    assert exponential_rate(7_500, first, last, 30_000) == pytest.approx(first**0.75 * last**0.25, rel=1e-12)
    assert exponential_rate(30_000, first, last, 30_000) == pytest.approx(last, rel=1e-12)
    assert exponential_rate(40_000, first, last, 30_000) == pytest.approx(last, rel=1e-12)


def test_learning_rates_are_those_of_3dgs():
    optimizer = GaussianOptimizer(random_model(), TrainConfig(), extent=4.0)
    rates = {group["name"]: group["lr"] for group in optimizer.adam.param_groups}
    assert rates == {"means3D": 0.00016 * 4, "dc": 0.0025, "shs": 0.000125, "opacities": 0.05, "scales": 0.005,
                     "rotations": 0.001}
    optimizer.set_position_rate(30_000)
    assert optimizer.adam.param_groups[0]["lr"] == pytest.approx(0.0000016 * 4)
    assert all(group["eps"] == 1e-15 and group["betas"] == (0.9, 0.999) for group in optimizer.adam.param_groups)


def test_bands_that_join_late_step_as_if_they_had_seen_zero_gradients():
    """Leaving the higher SH bands out while degree 0 is active must not change the numbers."""
    model = random_model()
    optimizer = GaussianOptimizer(model, TrainConfig(), extent=1.0)
    twin = model.raw["shs"].detach().clone().requires_grad_()
    plain = torch.optim.Adam([twin], lr=0.0025 / 20, eps=1e-15)
    generator = torch.Generator().manual_seed(1)
    for step in range(6):
        gradient = torch.randn(twin.shape, generator=generator) if step >= 3 else torch.zeros(twin.shape)
        twin.grad = gradient
        for name in PARAMETERS:
            model.raw[name].grad = torch.ones_like(model.raw[name])
        model.raw["shs"].grad = gradient.clone() if step >= 3 else None
        plain.step()
        optimizer.step()
    # float32; a fused kernel rounds once less. Without the step count the first update would be 1.9 times larger.
    torch.testing.assert_close(model.raw["shs"], twin, rtol=1e-6, atol=1e-7)
    assert (model.raw["shs"].detach() - random_model().raw["shs"].detach()).abs().max() > 1e-4


def test_degree_zero_renders_the_base_colour_alone():
    model = random_model()
    assert set(model.color_arguments()) == {"shs"}
    model.raise_sh_degree()
    assert model.active_sh_degree == 1 and set(model.color_arguments()) == {"dc", "shs"}
    for _ in range(5):
        model.raise_sh_degree()
    assert model.active_sh_degree == 3


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_ply_round_trip(tmp_path, mode, sh_degree):
    model = random_model(sh_degree=sh_degree)
    path = str(tmp_path / "deep" / "model.ply")
    faint_below = sh_degree / 7 or None  # whose digits do not end
    save_model(path, model, mode, 0.1, faint_below)
    loaded, recorded = load_model(path, "cpu")
    assert recorded == (mode, 0.1 if mode in GATED_MODES else None, faint_below), "the others have no choice"
    assert loaded.sh_degree == loaded.active_sh_degree == sh_degree
    for name in PARAMETERS:
        assert torch.equal(loaded.raw[name], model.raw[name]), name


def test_a_file_that_records_no_blend_mode_is_alpha_and_says_so(capsys):
    assert agreed_blend_mode("a.ply", "smoe", None) == "smoe"
    assert agreed_blend_mode("a.ply", None, "alpha") == "alpha"
    assert not capsys.readouterr().err and agreed_blend_mode("a.ply", None, None) == "alpha"
    assert "note: a.ply records no blend mode, so it is alpha" in capsys.readouterr().err
    with pytest.raises(TrainerError, match="trained with the blend mode smoe, not alpha"):
        agreed_blend_mode("a.ply", "smoe", "alpha")
    with pytest.raises(TrainerError, match="'future'"):
        agreed_blend_mode("a.ply", "future", None)


@pytest.mark.parametrize("mode, recorded, asked, expected", [
    ("smoe", ("smoe", 0.1), None, 0.1),
    ("smoe", ("smoe", 0.1), 0.1, 0.1),
    ("smoe", ("smoe", 0.1), 0.2, r"a\.ply was trained with the background gate 0\.1, not 0\.2"),
    ("smoe_eq7", ("smoe_eq7", None), None, 0.0),  # older files are of Eq. 7
    ("smoe_eq7", ("smoe_eq7", None), 0.05, "background gate 0.0, not 0.05"),
    ("smoe", (None, None), None, r"a\.ply does not say which background gate.*--background-gate"),
    ("smoe", (None, None), 0.2, 0.2),
    ("smoe", (None, None), -1.0, "background_gate is -1.0"),
    ("alpha", ("alpha", None), None, 1.0),
    ("alpha", (None, None), 1.0, 1.0),
    ("alpha", (None, None), 0.1, "background gate is 0.1; in the blend mode alpha it is 1"),
    ("alpha", (None, 0.1), None, "background gate is 0.1; in the blend mode alpha it is 1"),
    ("smoe_tn", ("smoe_tn", None), 0.0, 0.0),
])
def test_background_gate_of_a_file_is_never_guessed(monkeypatch, mode, recorded, asked, expected):
    monkeypatch.setenv("DSMOE_BACKGROUND_GATE", "0.7")  # must not fill the gap
    if isinstance(expected, float):
        assert agreed_background_gate("a.ply", mode, Recorded(*recorded), asked) == expected
    else:
        with pytest.raises(TrainerError, match=expected):
            agreed_background_gate("a.ply", mode, Recorded(*recorded), asked)


def test_a_damaged_ply_is_named(tmp_path):
    path = tmp_path / "model.ply"
    save_model(str(path), random_model(), "alpha", 1.0)
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(TrainerError, match="model.ply"):
        load_model(str(path), "cpu")
    with pytest.raises(TrainerError, match="nowhere.ply"):
        load_model(str(tmp_path / "nowhere.ply"), "cpu")


def test_files_of_other_programs_load_without_a_mode(tmp_path):
    model = random_model()
    raw = {name: tensor.detach().numpy() for name, tensor in model.raw.items()}
    io.write_gaussians(str(tmp_path / "a.ply"), io.Gaussians(
        raw["means3D"], raw["dc"], raw["shs"], raw["opacities"], raw["scales"], raw["rotations"]))
    assert load_model(str(tmp_path / "a.ply"), "cpu")[1] == (None, None, None)
