"""Dense Adam against torch.optim.Adam, visible-only Adam against its formula; on every device."""
from __future__ import annotations

import copy
import subprocess
import sys

import pytest
import torch
from devices import default_device, random_normal

from diff_smoe_rasterization.optimizers import FusedAdam, SparseGaussianAdam

# Sizes below, at and above a GPU block's 1024 numbers and a CPU thread's 65536, one of them empty.
SIZES = [(1,), (7, 3), (1024,), (1025,), (0, 4), (300, 45), (65536 + 5, 2)]
# Both compute in the parameter's precision, in another order of operations: a few units in the last place a step, of
# numbers and steps of order 1.
TOLERANCE = {torch.float32: 2e-6, torch.float64: 1e-14}


def random_parameters(dtype, shapes=SIZES, seed=0):
    return [random_normal(shape, seed + i, dtype).requires_grad_() for i, shape in enumerate(shapes)]


def set_gradients(parameters, seed):
    for i, parameter in enumerate(parameters):
        parameter.grad = random_normal(parameter.shape, 1000 * (seed + 1) + i, parameter.dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dense_adam_is_that_of_torch(device, dtype):
    ours, theirs = random_parameters(dtype), random_parameters(dtype)
    optimizers = [
        FusedAdam([{"params": ours[:3], "lr": 0.1}, {"params": ours[3:]}], lr=0.02, eps=1e-15),
        torch.optim.Adam([{"params": theirs[:3], "lr": 0.1}, {"params": theirs[3:]}], lr=0.02, eps=1e-15),
    ]
    for step in range(5):
        for parameters, optimizer in zip([ours, theirs], optimizers):
            set_gradients(parameters, step)
            optimizer.param_groups[0]["lr"] = 0.1 / (1 + step)
            optimizer.step()
    for mine, reference in zip(ours, theirs):
        torch.testing.assert_close(mine, reference, rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])
        for key in ("exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(optimizers[0].state[mine][key], optimizers[1].state[reference][key],
                                       rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])
        assert optimizers[0].state[mine]["step"] == 5


def test_groups_with_settings_of_their_own(device):
    ours, theirs = random_parameters(torch.float64, [(9,)] * 3), random_parameters(torch.float64, [(9,)] * 3)

    def groups(parameters):
        return [{"params": parameters[:1], "betas": [0.5, 0.8]}, {"params": parameters[1:2], "eps": 0.1},
                {"params": parameters[2:]}]

    optimizers = [FusedAdam(groups(ours), lr=0.1), torch.optim.Adam(groups(theirs), lr=0.1)]
    for parameters, optimizer in zip([ours, theirs], optimizers):
        for step in range(3):
            set_gradients(parameters, step)
            optimizer.step()
    for mine, reference in zip(ours, theirs):
        torch.testing.assert_close(mine, reference, rtol=1e-14, atol=1e-14)


def test_more_tensors_than_one_launch_holds(device):
    shapes = [(i + 1,) for i in range(40)]
    ours, theirs = random_parameters(torch.float64, shapes), random_parameters(torch.float64, shapes)
    optimizers = [FusedAdam(ours, lr=0.1), torch.optim.Adam(theirs, lr=0.1)]
    for parameters, optimizer in zip([ours, theirs], optimizers):
        set_gradients(parameters, 0)
        optimizer.step()
    for mine, reference in zip(ours, theirs):
        torch.testing.assert_close(mine, reference, rtol=1e-14, atol=1e-14)


def test_the_first_step_is_the_learning_rate_against_the_gradient(device):
    parameter = random_normal((50, 3), 0).requires_grad_()
    before = parameter.detach().clone()
    set_gradients([parameter], 0)
    FusedAdam([parameter], lr=0.25, eps=1e-15).step()
    # Both corrected moments of the first step are the gradient's own; epsilon is far below them.
    torch.testing.assert_close(parameter.detach(), before - 0.25 * parameter.grad.sign(), rtol=1e-12, atol=1e-12)


def test_parameters_without_a_gradient_stay(device):
    still, moving = random_parameters(torch.float32, [(5,), (5,)])
    before = still.detach().clone()
    set_gradients([moving], 0)
    optimizer = FusedAdam([still, moving], lr=0.1)
    optimizer.step()
    assert torch.equal(still, before) and still not in optimizer.state
    assert optimizer.state[moving]["step"] == 1


def test_a_gradient_need_not_be_dense(device):
    ours, theirs = random_parameters(torch.float64, [(6, 4)]), random_parameters(torch.float64, [(6, 4)])
    for parameters, optimizer in ((ours, FusedAdam(ours, lr=0.1)), (theirs, torch.optim.Adam(theirs, lr=0.1))):
        parameters[0].grad = random_normal((4, 6), 3).t()
        optimizer.step()
    torch.testing.assert_close(ours[0], theirs[0], rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("make, step", [
    (lambda parameter: FusedAdam([parameter], lr=0.1), lambda optimizer: optimizer.step()),
    (lambda parameter: SparseGaussianAdam([{"params": [parameter]}], lr=0.1, eps=1e-15),
     lambda optimizer: optimizer.step(torch.tensor([True, False, True, True, False]), 5))], ids=["dense", "sparse"])
def test_a_parameter_with_other_strides(device, make, step):
    """As a trainer makes from the transposed array of a point cloud's coordinates."""
    numbers = random_normal((3, 5), 4, torch.float64)
    transposed, dense = numbers.clone().t().requires_grad_(), numbers.t().contiguous().requires_grad_()
    assert not transposed.is_contiguous()
    optimizers = [(parameter, make(parameter)) for parameter in (transposed, dense)]
    for seed in range(3):
        for parameter, optimizer in optimizers:
            parameter.grad = random_normal((5, 3), seed, torch.float64)
            step(optimizer)
    assert not transposed.is_contiguous() and torch.equal(transposed, dense)
    assert not torch.equal(dense, numbers.t())


@pytest.mark.parametrize("first, second", [(torch.optim.Adam, FusedAdam), (FusedAdam, torch.optim.Adam)])
def test_either_adam_takes_the_state_of_the_other(device, first, second):
    before, after = random_parameters(torch.float64, [(30,)]), random_parameters(torch.float64, [(30,)])
    giving, taking = first(before, lr=0.1), second(after, lr=0.3)
    set_gradients(before, 0)
    giving.step()
    taking.load_state_dict(copy.deepcopy(giving.state_dict()))  # torch would share the moments
    with torch.no_grad():
        after[0].copy_(before[0])
    for parameters, optimizer in ((before, giving), (after, taking)):
        set_gradients(parameters, 1)
        optimizer.step()
    torch.testing.assert_close(after[0], before[0], rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("dtype, options", [
    (torch.float64, {"weight_decay": 0.1}), (torch.float64, {"amsgrad": True}), (torch.float64, {"maximize": True}),
    (torch.bfloat16, {})])
def test_what_the_kernel_does_not_have_is_computed_by_torch(device, dtype, options):
    ours, theirs = random_parameters(dtype, [(30,), (4, 3)]), random_parameters(dtype, [(30,), (4, 3)])
    groups = [[{"params": parameters[:1], **options}, {"params": parameters[1:]}] for parameters in (ours, theirs)]
    optimizers = [FusedAdam(groups[0], lr=0.1), torch.optim.Adam(groups[1], lr=0.1)]
    before = ours[0].detach().clone()
    for seed in range(4):
        for parameters, optimizer in zip((ours, theirs), optimizers):
            set_gradients(parameters, seed)
            optimizer.step()
    assert all(torch.equal(mine, other) for mine, other in zip(ours, theirs)) and not torch.equal(ours[0], before)


def test_a_group_may_ask_for_more_later(device):
    ours, theirs = random_parameters(torch.float64, [(30,)]), random_parameters(torch.float64, [(30,)])
    for parameters, optimizer in ((ours, FusedAdam(ours, lr=0.1)), (theirs, torch.optim.Adam(theirs, lr=0.1))):
        for seed, decay in enumerate((0, 0.1, 0)):
            optimizer.param_groups[0]["weight_decay"] = decay
            set_gradients(parameters, seed)
            assert optimizer.step(lambda seed=seed: seed) == seed
    torch.testing.assert_close(ours[0], theirs[0], rtol=1e-14, atol=1e-14)


def test_autograd_notices_the_step(device):
    parameter = random_normal((3,), 0).requires_grad_()
    output = (parameter * parameter).sum()
    parameter.grad = torch.ones_like(parameter)
    FusedAdam([parameter], lr=0.1).step()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        output.backward()


def test_bad_settings_are_refused():
    parameter = torch.zeros(2, requires_grad=True)
    for name, settings in {"lr": {"lr": -1.0}, "eps": {"eps": -1.0}, "betas": {"betas": (0.9, 1.0)}}.items():
        with pytest.raises(ValueError, match=f"FusedAdam: {name} is"):
            FusedAdam([parameter], **settings)


def test_bad_tensors_are_refused(device):
    half = torch.zeros(2, dtype=torch.float16, requires_grad=True)
    half.grad = torch.ones_like(half)
    with pytest.raises(TypeError, match=r"adam: parameters\[0\] is float16"):
        SparseGaussianAdam([{"params": [half]}], lr=0.1, eps=1e-15).step(torch.ones(2, dtype=torch.bool), 2)


def sparse_adam_by_hand(parameter, moment, square, gradient, visible, rate, epsilon):
    """Adam without bias correction on the visible rows, in double."""
    moment, square, parameter = moment.clone(), square.clone(), parameter.clone()
    moment[visible] = 0.9 * moment[visible] + 0.1 * gradient[visible]
    square[visible] = 0.999 * square[visible] + 0.001 * gradient[visible] ** 2
    parameter[visible] -= rate * moment[visible] / (square[visible].sqrt() + epsilon)
    return parameter, moment, square


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [1, 2000])
def test_sparse_adam_steps_the_visible_rows(device, dtype, count):
    shapes = [(count, 3), (count, 1), (count, 15, 3)]
    parameters = random_parameters(dtype, shapes)
    rates = [0.1, 0.01, 0.001]
    groups = [{"params": [p], "lr": rate} for p, rate in zip(parameters, rates)]
    optimizer = SparseGaussianAdam(groups, lr=0.0, eps=1e-15)
    zeros = [torch.zeros_like(p).double() for p in parameters]
    expected = [(p.detach().clone().double(), zero, zero) for p, zero in zip(parameters, zeros)]
    for step in range(4):
        visible = random_normal((count,), 77 + step) > 0
        set_gradients(parameters, step)
        optimizer.step(visible, count)
        expected = [sparse_adam_by_hand(*state, p.grad.double(), visible, rate, 1e-15)
                    for state, p, rate in zip(expected, parameters, rates)]
    for parameter, (value, moment, square) in zip(parameters, expected):
        state = optimizer.state[parameter]
        for actual, wanted in ((parameter, value), (state["exp_avg"], moment), (state["exp_avg_sq"], square)):
            torch.testing.assert_close(actual.detach().double(), wanted, rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])


def test_rows_out_of_sight_keep_every_bit(device):
    parameter = random_normal((100, 7), 0, torch.float32).requires_grad_()
    before = parameter.detach().clone()
    visible = torch.zeros(100, dtype=torch.bool)
    visible[17:40] = True
    optimizer = SparseGaussianAdam([parameter], lr=0.1, eps=1e-15)
    set_gradients([parameter], 0)
    optimizer.step(visible, 100)
    assert torch.equal(parameter[~visible], before[~visible])
    assert not optimizer.state[parameter]["exp_avg"][~visible].any()
    assert (parameter[visible] != before[visible]).all()


def test_sparse_adam_of_nothing(device):
    parameter = torch.zeros(0, 3, requires_grad=True)
    parameter.grad = torch.zeros(0, 3)
    SparseGaussianAdam([parameter], lr=0.1, eps=1e-15).step(torch.zeros(0, dtype=torch.bool), 0)
    assert parameter.shape == (0, 3)


def test_sparse_adam_is_an_optimizer_that_densification_can_edit(device):
    """3DGS trainers reach into param_groups and state, and change learning rates."""
    parameter = random_normal((4, 3), 0).requires_grad_()
    optimizer = SparseGaussianAdam([{"params": [parameter], "lr": 0.1, "name": "xyz"}], lr=0.0, eps=1e-15)
    set_gradients([parameter], 0)
    optimizer.step(torch.ones(4, dtype=torch.bool), 4)
    state = optimizer.state.pop(parameter)
    longer = torch.cat([parameter.detach(), torch.ones(2, 3, dtype=parameter.dtype)]).requires_grad_()
    for key in ("exp_avg", "exp_avg_sq"):
        state[key] = torch.cat([state[key], torch.zeros(2, 3, dtype=parameter.dtype)])
    optimizer.state[longer] = state
    optimizer.param_groups[0]["params"][0] = longer
    optimizer.param_groups[0]["lr"] = 0.0
    before = longer.detach().clone()
    set_gradients([longer], 1)
    optimizer.step(torch.ones(6, dtype=torch.bool), 6)
    assert torch.equal(longer, before), "the learning rate is 0"
    assert optimizer.state[longer]["exp_avg"].shape == (6, 3)


def test_sparse_adam_refuses_what_does_not_fit(device):
    parameter = torch.zeros(4, 3, requires_grad=True)
    parameter.grad = torch.ones_like(parameter)
    optimizer = SparseGaussianAdam([parameter], lr=0.1, eps=1e-15)
    with pytest.raises(ValueError, match="visibility has shape"):
        optimizer.step(torch.ones(3, dtype=torch.bool), 4)
    with pytest.raises(ValueError, match=r"adam: parameters\[0\] has shape"):
        optimizer.step(torch.ones(5, dtype=torch.bool), 5)
    with pytest.raises(TypeError, match="adam: visible is int32"):
        optimizer.step(torch.ones(4, dtype=torch.int32), 4)


def test_a_gpu_and_the_cpu_agree(device):
    """float32 on the device against double on the CPU, over rows as wide as a Gaussian's."""
    if default_device().type == "cpu":
        pytest.skip("compares a GPU with the CPU")
    gpu = random_normal((5000, 59), 0, torch.float32).requires_grad_()
    cpu = gpu.detach().cpu().double().requires_grad_()
    optimizers = [FusedAdam([gpu], lr=0.01, eps=1e-15), FusedAdam([cpu], lr=0.01, eps=1e-15)]
    for step in range(10):
        set_gradients([gpu], step)
        cpu.grad = gpu.grad.cpu().double()
        for optimizer in optimizers:
            optimizer.step()
    # Ten roundings of numbers up to 5 in float32.
    torch.testing.assert_close(gpu.detach().cpu().double(), cpu.detach(), rtol=0, atol=1e-5)


@pytest.mark.parametrize("wrong", [None, "a", [1.0], {}])
def test_settings_that_are_no_numbers_are_named(wrong):
    parameter, kind = torch.zeros(4, 3, requires_grad=True), type(wrong).__name__
    for optimizer in (FusedAdam, SparseGaussianAdam):
        for name in ("lr", "eps"):
            with pytest.raises(TypeError, match=f"{optimizer.__name__}: {name} is of type {kind}; it must be a number"):
                optimizer([parameter], **{"lr": 0.1, "eps": 1e-15, name: wrong})
    with pytest.raises(TypeError, match="FusedAdam: betas is "):
        FusedAdam([parameter], betas=wrong)
    with pytest.raises(TypeError, match=f"FusedAdam: betas is of type {kind}; it must be a number"):
        FusedAdam([parameter], betas=(0.9, wrong))
    sparse = SparseGaussianAdam([parameter], lr=0.1, eps=1e-15)
    with pytest.raises(TypeError, match=f"SparseGaussianAdam.step: visibility is of type {kind}; it must be a torch"):
        sparse.step(wrong, 4)
    with pytest.raises(TypeError, match=f"SparseGaussianAdam.step: N is of type {kind}; it must be a number"):
        sparse.step(torch.ones(4, dtype=torch.bool), wrong)


def test_a_learning_rate_may_be_a_tensor(device):
    first, second = (torch.ones(3, requires_grad=True) for _ in range(2))
    for parameter, rate in ((first, 0.1), (second, torch.tensor(0.1, dtype=torch.float64))):
        set_gradients([parameter], 0)
        FusedAdam([parameter], lr=rate).step()
    assert torch.equal(first, second) and float(first.detach()[0]) != 1


def test_no_compiler_is_loaded_to_make_an_optimizer(tmp_path):
    """torch's own loads torch._dynamo, with every first training: 2 s here."""
    program = ("import sys, torch; from diff_smoe_rasterization import FusedAdam, SparseGaussianAdam; "
               "FusedAdam([torch.zeros(1)]), SparseGaussianAdam([{'params': [torch.zeros(1, 1)]}], 0.1, 1e-8); "
               "sys.exit('torch._dynamo' in sys.modules)")
    assert subprocess.run([sys.executable, "-c", program], cwd=tmp_path).returncode == 0
