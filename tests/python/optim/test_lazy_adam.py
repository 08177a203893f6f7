"""LazyAdam against FusedAdam, bit for bit: rows that are seen now and then, long after, or never."""
from __future__ import annotations

import copy

import pytest
import torch
from devices import random_normal

from diff_smoe_rasterization import FusedAdam, LazyAdam, lazy_adam

SHAPES = [(700, 1, 3), (700, 15, 3)]  # more rows than a block of a kernel has threads, in widths of its own
EPSILON = 1e-15


def parameters_of(dtype, shapes=SHAPES):
    return [random_normal(shape, seed, dtype).requires_grad_() for seed, shape in enumerate(shapes)]


def adam_of(parameters, betas=(0.9, 0.999)):
    return FusedAdam([{"params": [parameter], "lr": 0.01 / (1 + i)} for i, parameter in enumerate(parameters)],
                     betas=betas, eps=EPSILON)


def radii_of(step, rows):
    """Which rows a step sees: a third at random, the first always, the second first in step 9, the last never."""
    radii = (random_normal((rows,), 100 + step) > 0.4).int()
    radii[0], radii[1], radii[-1] = 7, int(step == 9), 0
    return radii


def gradients_of(step, radii, parameters):
    """Zero if the row is not seen."""
    seen = (radii > 0).to(parameters[0].dtype)
    return [random_normal(parameter.shape, 1000 * step + i, parameter.dtype)
            * seen.view(-1, *[1] * (parameter.dim() - 1)) for i, parameter in enumerate(parameters)]


def dense_steps(adam, parameters, steps):
    for step in steps:
        gradients = gradients_of(step, radii_of(step, len(parameters[0])), parameters)
        for parameter, gradient in zip(parameters, gradients):
            parameter.grad = gradient
        adam.step()


def lazy_steps(lazy, steps):
    """As a trainer does it: what a step does not see must not be read, and has gradients that mean nothing."""
    for step in steps:
        radii = radii_of(step, len(lazy.parameters[0]))
        lazy.catch_up(radii)
        gradients = gradients_of(step, radii, lazy.parameters)
        for waiting, gradient in zip(lazy.gradients, gradients):
            waiting[radii > 0] = gradient[radii > 0]
        lazy.step(radii)


def assert_equal(mine, others, parameters):
    for parameter, other in zip(*parameters):
        assert torch.equal(parameter, other)
        for key in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(mine.state[parameter][key], others.state[other][key])
        assert mine.state[parameter]["step"] == others.state[other]["step"]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("capacity", [4096, 7])
def test_lazy_is_dense_bit_for_bit(device, monkeypatch, dtype, capacity):
    """capacity: of steps; beyond it every row is brought up to date on the way."""
    monkeypatch.setattr(lazy_adam, "_CAPACITY", capacity)
    lazy_parameters, dense_parameters = parameters_of(dtype), parameters_of(dtype)
    lazily, densely = adam_of(lazy_parameters), adam_of(dense_parameters)
    lazy = LazyAdam(lazily, lazy_parameters)
    lazy_steps(lazy, range(20))
    dense_steps(densely, dense_parameters, range(20))
    assert not torch.equal(lazy_parameters[1], dense_parameters[1]), "rows must have waited"
    lazy.catch_up()
    assert_equal(lazily, densely, (lazy_parameters, dense_parameters))
    assert torch.equal(lazy_parameters[0][-1], parameters_of(dtype)[0][-1]), "what is never seen stays"


def test_rows_that_are_caught_up_are_those_of_dense_adam(device):
    lazy_parameters, dense_parameters = parameters_of(torch.float32), parameters_of(torch.float32)
    lazy = LazyAdam(adam_of(lazy_parameters), lazy_parameters)
    lazy_steps(lazy, range(12))
    dense_steps(adam_of(dense_parameters), dense_parameters, range(12))
    before = lazy_parameters[1].detach().clone()
    radii = radii_of(12, 700)
    lazy.catch_up(radii)
    seen = radii > 0
    assert torch.equal(lazy_parameters[1][seen], dense_parameters[1][seen])
    assert torch.equal(lazy_parameters[1][~seen], before[~seen]), "the others are not touched"


def test_a_break_with_a_checkpoint_and_other_rates_on_the_way(device):
    """State that is taken while rows wait is complete after catch_up(). Learning rates and rows change on the way."""
    lazy_parameters, dense_parameters = parameters_of(torch.float64), parameters_of(torch.float64)
    lazily, densely = adam_of(lazy_parameters), adam_of(dense_parameters)
    lazy = LazyAdam(lazily, lazy_parameters)
    for first in (0, 3, 6):
        for adam in (lazily, densely):
            adam.param_groups[0]["lr"] = 0.1 / (1 + first)
        lazy_steps(lazy, range(first, first + 3))
        dense_steps(densely, dense_parameters, range(first, first + 3))
    lazy.catch_up()
    resumed_parameters = [parameter.detach().clone().requires_grad_() for parameter in lazy_parameters]
    resumed = adam_of(resumed_parameters)
    resumed.load_state_dict(copy.deepcopy(lazily.state_dict()))
    with torch.no_grad():
        for parameters in (resumed_parameters, dense_parameters, lazy_parameters):
            parameters[1][5] = 2.0
    for goes_on in (lazy, LazyAdam(resumed, resumed_parameters)):
        lazy_steps(goes_on, range(9, 15))
        goes_on.catch_up()
    dense_steps(densely, dense_parameters, range(9, 15))
    assert_equal(lazily, densely, (lazy_parameters, dense_parameters))
    assert_equal(resumed, densely, (resumed_parameters, dense_parameters))


def test_state_that_is_loaded_between_steps_is_taken(device):
    """What load_state_dict puts in place of groups and moments: here learning rates of 0, 0.1 and other moments."""
    lazy_parameters, dense_parameters = parameters_of(torch.float32), parameters_of(torch.float32)
    lazily, densely = adam_of(lazy_parameters), adam_of(dense_parameters)
    lazy = LazyAdam(lazily, lazy_parameters)
    lazy_steps(lazy, range(3))
    dense_steps(densely, dense_parameters, range(3))
    lazy.catch_up()
    for adam in (lazily, densely):
        state = copy.deepcopy(adam.state_dict())
        state["param_groups"][0]["lr"], state["param_groups"][1]["lr"] = 0.0, 0.1
        state["state"][0]["exp_avg"].fill_(1.0)
        adam.load_state_dict(state)
    before = lazy_parameters[0].detach().clone()
    lazy_steps(lazy, range(3, 6))
    dense_steps(densely, dense_parameters, range(3, 6))
    lazy.catch_up()
    assert torch.equal(lazy_parameters[0], before)
    assert_equal(lazily, densely, (lazy_parameters, dense_parameters))


def fill_moments(lazy):
    lazy.adam.state[lazy.parameters[0]]["exp_avg"].fill_(0.5)


def replace_state(lazy):
    lazy.adam.state[lazy.parameters[1]] = copy.deepcopy(lazy.adam.state[lazy.parameters[1]])


@torch.no_grad()
def move(lazy):
    lazy.parameters[1][3] = 2.0


@pytest.mark.parametrize("change", [
    lambda lazy: lazy.adam.load_state_dict(copy.deepcopy(lazy.adam.state_dict())), fill_moments, replace_state, move,
    lambda lazy: lazy.adam.state.clear(),
    lambda lazy: [group.update(betas=(0.8, 0.99)) for group in lazy.adam.param_groups]])
def test_a_change_while_steps_wait_is_refused(device, change):
    parameters = parameters_of(torch.float32)
    lazy = LazyAdam(adam_of(parameters), parameters)
    lazy_steps(lazy, range(2))
    change(lazy)
    for call in (lazy.catch_up, lambda: lazy.step(radii_of(2, 700))):
        with pytest.raises(RuntimeError, match="changed while 2 steps wait.*catch_up"):
            call()
    lazy_steps(LazyAdam(lazy.adam, parameters), range(2, 4))


def test_a_long_wait(device):
    """Momentum fades to nothing, and so does the second moment, in as many roundings as dense Adam makes."""
    lazy_parameters, dense_parameters = parameters_of(torch.float32, [(3, 2)]), parameters_of(torch.float32, [(3, 2)])
    lazily, densely = adam_of(lazy_parameters, (0.5, 0.9)), adam_of(dense_parameters, (0.5, 0.9))
    lazy = LazyAdam(lazily, lazy_parameters)
    lazy.gradients[0].fill_(1e-3)
    for step in range(300):
        lazy.step(torch.full((3,), int(step == 0), dtype=torch.int32))
        dense_parameters[0].grad = torch.full_like(dense_parameters[0], 1e-3 if step == 0 else 0.0)
        densely.step()
    lazy.catch_up()
    assert_equal(lazily, densely, (lazy_parameters, dense_parameters))


def test_what_does_not_fit_is_refused(device):
    first, second = parameters_of(torch.float32, [(4, 3), (4, 2)])
    with pytest.raises(ValueError, match="not among those of adam"):
        LazyAdam(adam_of([first]), [second])
    with pytest.raises(ValueError, match="differ in betas or eps"):
        LazyAdam(FusedAdam([{"params": [first]}, {"params": [second], "eps": 0.5}]), [first, second])
    decaying = adam_of([first])
    decaying.param_groups[0]["weight_decay"] = 0.1
    with pytest.raises(ValueError, match="asks for weight_decay"):
        LazyAdam(decaying, [first])
    adam = adam_of([first, second])
    first.grad = torch.ones_like(first)
    adam.step()
    with pytest.raises(ValueError, match="different numbers of steps"):
        LazyAdam(adam, [first, second])
    lazy = LazyAdam(adam_of([first]), [first])
    with pytest.raises(ValueError, match="radii has shape"):
        lazy.step(torch.ones(3, dtype=torch.int32))
    with pytest.raises(TypeError, match="radii is bool"):
        lazy.step(torch.ones(4, dtype=torch.bool))
    for function in (lazy.step, lazy.catch_up):
        with pytest.raises(TypeError, match=f"LazyAdam.{function.__name__}: radii is of type list; it must be a torch"):
            function([1, 1, 1, 1])
    assert lazy.adam.state[first]["step"] == 0, "what was refused is not a step"
    with pytest.raises(TypeError, match="LazyAdam: adam is of type SGD; it must be a FusedAdam"):
        LazyAdam(torch.optim.SGD([first], lr=0.1), [first])
    with pytest.raises(TypeError, match=r"LazyAdam: parameters\[1\] is of type int; it must be a torch.Tensor"):
        LazyAdam(adam_of([first]), [first, 1])
    with pytest.raises(ValueError, match="LazyAdam: parameters is empty"):
        LazyAdam(adam_of([first]), [])
