"""Densification as 3DGS runs it: which Gaussians are cloned, split, pruned or reset, and their Adam state."""
from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from dsmoe.model import PARAMETERS, GaussianModel
from dsmoe.optimizer import GaussianOptimizer
from dsmoe.options.config import TrainConfig
from dsmoe.training.strategies import STRATEGIES
from dsmoe.training.strategy import Step, Strategy, StrategyContext

EXTENT = 10.0
SMALL, LARGE = 0.099, 0.101  # on either side of percent_dense * EXTENT = 0.1


def context_of(scales, opacities, **options):
    """Gaussians with these scales and opacities, other parameters random, whose Adam moments are their row number."""
    count = len(scales)
    generator = torch.Generator().manual_seed(0)
    raw = {
        "means3D": torch.randn(count, 3, generator=generator),
        "dc": torch.randn(count, 1, 3, generator=generator),
        "shs": torch.randn(count, 15, 3, generator=generator),
        "opacities": torch.logit(torch.tensor(opacities).view(-1, 1)),
        "scales": torch.log(torch.tensor(scales).view(-1, 1).repeat(1, 3)),
        "rotations": torch.randn(count, 4, generator=generator),
    }
    model = GaussianModel(raw, 3)
    config = TrainConfig(**options)
    optimizer = GaussianOptimizer(model, config, EXTENT)
    for name in PARAMETERS:
        model.raw[name].grad = torch.zeros_like(model.raw[name])
    optimizer.step()
    rows = torch.arange(1.0, count + 1)
    for name in PARAMETERS:
        state = optimizer.adam.state[model.raw[name]]
        for key in ("exp_avg", "exp_avg_sq"):
            state[key] += rows.view(-1, *[1] * (model.raw[name].dim() - 1))
    return StrategyContext(config, model, optimizer, EXTENT, [], lambda camera: None, iter)


def moments(context, name, key="exp_avg"):
    """[N] the moment of each row, which must be one number per row."""
    state = context.optimizer.adam.state[context.model.raw[name]][key].flatten(1)
    assert (state == state[:, :1]).all()
    return state[:, 0].tolist()


def observed_step(context, iteration, gradients, radii=None):
    """A step after its backward pass: gradients [N] are the norms of those by the places on the image."""
    values = torch.tensor(gradients)
    by_place = torch.stack([0.6 * values, -0.8 * values, torch.full_like(values, 99.0)], dim=1)
    radii = torch.ones(len(gradients), dtype=torch.int32) if radii is None else torch.tensor(radii, dtype=torch.int32)
    step = Step(iteration, 1, torch.zeros(()))
    step.seen.append((by_place, radii))
    return step


def run(strategy, *arguments, **keywords):
    with torch.no_grad():
        strategy.after_backward(observed_step(strategy.context, *arguments, **keywords))


def test_small_ones_are_cloned_and_large_ones_split():
    #                   keep   clone  split  keep   split
    context = context_of([SMALL, SMALL, LARGE, LARGE, LARGE], [0.5] * 5)
    before = {name: context.model.raw[name].detach().clone() for name in PARAMETERS}
    strategy = STRATEGIES["3dgs"](context)
    strategy.densify(torch.tensor([0.0001, 0.0002, 0.0003, 0.00019, 1.0]))
    model = context.model
    # 5 rows, 1 clone, 2 children for each of 2 parents, which disappear.
    assert model.num_gaussians == 5 + 1 + 2 * 2 - 2
    for name in PARAMETERS:
        rows = model.raw[name].detach()
        assert torch.equal(rows[:3], before[name][[0, 1, 3]]), "the others stay, in order"
        assert torch.equal(rows[3], before[name][1]), "a clone equals its original"
        if name not in ("means3D", "scales"):
            for child in range(4):
                assert torch.equal(rows[4 + child], before[name][[2, 4, 2, 4][child]]), name
    torch.testing.assert_close(model.scales[4:].detach(), torch.full((4, 3), LARGE / 1.6))
    assert len({tuple(row.tolist()) for row in model.raw["means3D"][4:]}) == 4, "children have places of their own"


def test_growth_takes_nothing_that_no_view_has_a_gradient_of():
    """However many are asked for."""
    context = context_of([SMALL] * 4, [0.5] * 4)
    before = context.model.raw["dc"].detach().clone()
    STRATEGIES["steady"](context).densify(torch.tensor([0.0, 1e-6, 0.0, 1e-5]), least=3)
    assert torch.equal(context.model.raw["dc"][4:], before[[1, 3]])


def test_learning_rates_are_those_of_3dgs():
    rates = {group["name"]: group["lr"] for group in context_of([SMALL], [0.5]).optimizer.adam.param_groups}
    published = {"means3D": 0.00016 * EXTENT, "dc": 0.0025, "shs": 0.000125, "opacities": 0.05, "scales": 0.005,
                 "rotations": 0.001}
    assert rates == pytest.approx(published)


def test_adam_forgets_the_new_and_remembers_the_old():
    context = context_of([SMALL, SMALL, LARGE, LARGE], [0.5] * 4)
    steps = [float(context.optimizer.adam.state[context.model.raw[name]]["step"]) for name in PARAMETERS]
    STRATEGIES["3dgs"](context).densify(torch.tensor([0.0, 1.0, 1.0, 0.0]))
    for name in PARAMETERS:
        for key in ("exp_avg", "exp_avg_sq"):
            assert moments(context, name, key) == [1, 2, 4, 0, 0, 0]
    assert steps == [float(context.optimizer.adam.state[context.model.raw[name]]["step"]) for name in PARAMETERS]
    assert len(context.optimizer.adam.state) == len(PARAMETERS), "nothing of the replaced parameters is left"


def test_children_are_drawn_from_their_parent():
    """Mean and covariance of many children of equal parents against R S^2 R^T."""
    count, scales, quaternion = 20_000, torch.tensor([0.9, 0.3, 0.15]), [0.5, -0.1, 0.7, 0.3]
    context = context_of([LARGE] * count, [0.5] * count)
    with torch.no_grad():
        context.model.raw["means3D"].copy_(torch.tensor([1.0, 2.0, 3.0]).expand(count, 3))
        context.model.raw["scales"].copy_(scales.log().expand(count, 3))
        context.model.raw["rotations"].copy_(torch.tensor(quaternion).expand(count, 4))
    torch.manual_seed(0)
    STRATEGIES["3dgs"](context).densify(torch.ones(count))
    children = context.model.raw["means3D"].detach().double()
    assert len(children) == 2 * count
    w, x, y, z = quaternion
    turn = torch.tensor(Rotation.from_quat([x, y, z, w]).as_matrix())
    expected = turn @ torch.diag(scales.double() ** 2) @ turn.T
    # Five standard errors of a mean, and of a covariance entry (at most sqrt(2) * 0.81), over 40,000 samples.
    torch.testing.assert_close(children.mean(dim=0), torch.tensor([1.0, 2, 3]).double(), rtol=0, atol=5 * 0.9 / 200)
    torch.testing.assert_close(torch.cov(children.T), expected, rtol=0, atol=5 * 1.15 / 200)


def test_faint_ones_are_pruned_and_large_ones_only_if_asked():
    context = context_of([0.1, 0.1, 0.999, 1.001], [0.0049, 0.0051, 0.5, 0.5])
    strategy = STRATEGIES["3dgs"](context)
    strategy.prune(large_too=False)
    assert moments(context, "means3D") == [2, 3, 4]
    strategy.prune(large_too=True)
    for name in PARAMETERS:
        assert moments(context, name) == [2, 3]


def test_reset_lowers_opacities_and_forgets_their_moments():
    context = context_of([SMALL] * 3, [0.5, 0.01, 0.006])
    STRATEGIES["3dgs"](context).reset_opacities()
    torch.testing.assert_close(context.model.opacities.detach().flatten(), torch.tensor([0.01, 0.01, 0.006]))
    assert moments(context, "opacities") == [0, 0, 0]
    assert moments(context, "means3D") == [1, 2, 3]


def test_gradients_are_averaged_over_the_views_that_saw_the_gaussian():
    # One step of 0.0003 seen in one of two views is over the threshold, 0.0003 and 0.00005 in both is not.
    context = context_of([SMALL] * 3, [0.5] * 3, densify_from_iter=0, densification_interval=2)
    strategy = STRATEGIES["3dgs"](context)
    run(strategy, 1, [0.0003, 0.0003, 0.0])
    run(strategy, 2, [0.00005, 0.00005, 0.0], radii=[0, 40, 1])
    assert moments(context, "means3D") == [1, 2, 3, 0]
    assert torch.equal(context.model.raw["means3D"][3], context.model.raw["means3D"][0])


def test_statistics_start_anew_after_a_densification():
    context = context_of([SMALL], [0.5], densify_from_iter=0, densification_interval=1)
    strategy = STRATEGIES["3dgs"](context)
    run(strategy, 1, [0.1])
    assert context.model.num_gaussians == 2
    run(strategy, 2, [0.0001, 0.0001])
    assert context.model.num_gaussians == 2


@pytest.mark.parametrize("iteration, densifies", [(500, False), (550, False), (600, True), (14_900, True),
                                                  (15_000, False), (15_100, False)])
def test_densification_calendar_of_3dgs(iteration, densifies):
    context = context_of([SMALL], [0.5])
    run(STRATEGIES["3dgs"](context), iteration, [1.0])
    assert context.model.num_gaussians == (2 if densifies else 1)


@pytest.mark.parametrize("strategy, iteration, resets", [("3dgs", 3000, True), ("3dgs", 2900, False),
                                                         ("3dgs", 12_000, True), ("3dgs", 15_000, False),
                                                         ("steady", 3000, False)])
def test_opacity_reset_calendar(strategy, iteration, resets):
    context = context_of([SMALL], [0.5])
    run(STRATEGIES[strategy](context), iteration, [0.0])
    assert float(context.model.opacities.detach()) == pytest.approx(0.01 if resets else 0.5, rel=1e-5)


@pytest.mark.parametrize("strategy, white, resets", [("3dgs", True, True), ("3dgs", False, False),
                                                     ("steady", True, False)])
def test_white_background_resets_once_more_where_densification_starts(strategy, white, resets):
    context = context_of([SMALL], [0.5], white_background=white)
    run(STRATEGIES[strategy](context), 500, [0.0])
    assert float(context.model.opacities.detach()) == pytest.approx(0.01 if resets else 0.5, rel=1e-5)


@pytest.mark.parametrize("strategy, iteration, survivors", [("3dgs", 3000, 2), ("3dgs", 3100, 1), ("steady", 3100, 2)])
def test_size_prune_works_only_after_the_first_reset(strategy, iteration, survivors):
    context = context_of([SMALL, 1.01], [0.5, 0.5])
    run(STRATEGIES[strategy](context), iteration, [0.0, 0.0])
    assert context.model.num_gaussians == survivors


def test_screen_size_prunes_nothing():
    """The 20-pixel prune of the published code never fires, so it must not fire here."""
    context = context_of([SMALL, SMALL], [0.5, 0.5])
    run(STRATEGIES["3dgs"](context), 6100, [0.0, 0.0], radii=[500, 21])
    assert context.model.num_gaussians == 2


def test_an_iteration_that_densifies_steps_nothing_and_one_that_resets_all_but_opacities():
    context = context_of([SMALL], [0.5], densify_from_iter=0, densification_interval=100, opacity_reset_interval=50)
    strategy, model = STRATEGIES["3dgs"](context), context.model

    def stepped(iteration):
        for name in PARAMETERS:
            model.raw[name].grad = torch.ones_like(model.raw[name])
        run(strategy, iteration, [0.0])
        before = {name: model.raw[name].detach().clone() for name in PARAMETERS}
        context.optimizer.step()
        return {name for name in PARAMETERS if not torch.equal(before[name], model.raw[name])}

    assert stepped(49) == set(PARAMETERS)
    assert stepped(50) == set(PARAMETERS) - {"opacities"}
    assert stepped(100) == set()


def test_everything_may_be_pruned():
    context = context_of([SMALL, SMALL], [0.001, 0.001])
    STRATEGIES["3dgs"](context).prune(large_too=True)
    assert context.model.num_gaussians == 0
    assert all(len(context.model.raw[name]) == 0 for name in PARAMETERS)


def test_state_round_trip():
    context = context_of([SMALL] * 2, [0.5] * 2)
    strategy, twin = STRATEGIES["3dgs"](context), STRATEGIES["3dgs"](context)
    run(strategy, 1, [0.25, 0.5], radii=[1, 0])
    twin.load_state_dict(strategy.state_dict())
    assert twin.gradient_sum.tolist() == [pytest.approx(0.25), 0.0]
    assert twin.view_count.tolist() == [1.0, 0.0]


def test_the_base_strategy_changes_nothing():
    context = context_of([SMALL, LARGE], [0.001, 0.5])
    strategy = Strategy(context)
    step = observed_step(context, 3100, [1.0, 1.0])
    strategy.before_backward(step)
    strategy.after_backward(step)
    strategy.after_step(step)
    assert context.model.num_gaussians == 2 and strategy.state_dict() == {}
    assert math.isclose(float(context.model.opacities[0].detach()), 0.001, rel_tol=1e-4)
