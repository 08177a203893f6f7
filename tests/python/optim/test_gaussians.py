"""Activations against torch and autograd, the statistics of densification, and rows by index; on every device."""
from __future__ import annotations

import math

import pytest
import torch
from devices import random_normal

from diff_smoe_rasterization import FusedAdam
from diff_smoe_rasterization.gaussians import activate, add_view, divided
from diff_smoe_rasterization.neighbors import distCUDA2

SHAPES = ((1,), (3,), (4,))  # opacities, scales, rotations of one Gaussian


def raw_parameters(count, dtype):
    return [3 * random_normal((count, *shape), i, dtype) for i, shape in enumerate(SHAPES)]


def by_torch(opacities, scales, rotations):
    return torch.sigmoid(opacities), torch.exp(scales), torch.nn.functional.normalize(rotations)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 1000])
def test_values_and_gradients_are_those_of_torch(device, dtype, count):
    raw = [tensor.requires_grad_() for tensor in raw_parameters(count, dtype)]
    exact = [tensor.detach().double().requires_grad_() for tensor in raw]
    values, expected = activate(*raw), by_torch(*exact)
    weights = [random_normal(value.shape, 10 + i) for i, value in enumerate(expected)]
    gradients = torch.autograd.grad(values, raw, [weight.to(dtype) for weight in weights])
    expected_gradients = torch.autograd.grad(expected, exact, weights)
    # A few roundings; exp of numbers up to 10 turns one in the exponent into ten in the value.
    tolerance = 1e-5 if dtype == torch.float32 else 1e-13
    for actual, wanted in zip([*values, *gradients], [*expected, *expected_gradients]):
        assert actual.dtype == dtype
        torch.testing.assert_close(actual.double(), wanted, rtol=tolerance, atol=tolerance)


def test_gradients_by_finite_differences(device):
    raw = [tensor.requires_grad_() for tensor in raw_parameters(5, torch.float64)]
    assert torch.autograd.gradcheck(activate, raw)


def test_a_value_that_nothing_depends_on_has_gradient_zero(device):
    raw = [tensor.requires_grad_() for tensor in raw_parameters(6, torch.float64)]
    activate(*raw)[1].sum().backward()
    assert not raw[0].grad.any() and not raw[2].grad.any()
    torch.testing.assert_close(raw[1].grad, raw[1].detach().exp(), rtol=1e-13, atol=0)


def test_extremes_stay_finite(device):
    opacities = torch.tensor([[-1000.0], [1000.0], [0.0]], requires_grad=True)
    scales = torch.tensor([[-200.0, 0, 1]] * 3, requires_grad=True)
    rotations = torch.tensor([[0.0, 0, 0, 0], [1e-20, 0, 0, 0], [0, 3e4, 4e4, 0]], requires_grad=True)
    values = activate(opacities, scales, rotations)
    assert values[0].flatten().tolist() == [0.0, 1.0, 0.5]
    assert values[2][0].tolist() == [0.0] * 4
    torch.testing.assert_close(values[2][2], torch.tensor([0.0, 0.6, 0.8, 0]))
    sum(value.sum() for value in values).backward()
    for tensor in (opacities, scales, rotations):
        assert torch.isfinite(tensor.grad).all()


def test_nothing_is_recorded_without_gradients(device):
    raw = [tensor.requires_grad_() for tensor in raw_parameters(3, torch.float32)]
    with torch.no_grad():
        assert not any(value.requires_grad for value in activate(*raw))
    assert not any(value.requires_grad for value in activate(*(tensor.detach() for tensor in raw)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_statistics_count_views_and_screen_space_gradients(device, dtype):
    gradient_sum, view_count = torch.zeros(700, dtype=dtype), torch.zeros(700, dtype=dtype)
    expected_sum, expected_count = torch.zeros(700).double(), torch.zeros(700).double()
    for view in range(3):
        gradients = random_normal((700, 3), view, dtype)  # z must not count, nor what is out of sight
        radii = (10 * random_normal((700,), 50 + view)).int().clamp(min=0)
        add_view(gradients, radii, gradient_sum, view_count)
        expected_sum = expected_sum + gradients[:, :2].double().norm(dim=1) * (radii > 0)
        expected_count = expected_count + (radii > 0)
    assert torch.equal(view_count.double(), expected_count) and set(view_count.tolist()) == {0, 1, 2, 3}
    tolerance = 1e-6 if dtype == torch.float32 else 1e-14  # a few roundings
    torch.testing.assert_close(gradient_sum.double(), expected_sum, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_reach_of_a_footprint_with_its_tails(device, dtype):
    """Where opacity G is 2^-35, or further if a pair counts there, and never within the radius of 3 sigma."""
    radii = torch.tensor([3, 3, 9, 30, 0, 6, 6], dtype=torch.int32)
    values = torch.tensor([[0.5, 11], [1e-6, 36], [1e-11, -4], [1e-11, 16], [0.5, 11], [0, -1e30], [-1, -1e30]],
                          dtype=dtype)
    found = torch.ops.diff_smoe_rasterization.pixel_reach(radii, values[:, 0], values[:, 1])
    expected = torch.tensor([math.sqrt(2 * math.log(0.5 * 2**35)), 6, 9, 40, 0, 6, 6], dtype=dtype)
    torch.testing.assert_close(found, expected, rtol=1e-6 if dtype == torch.float32 else 1e-14, atol=0)
    with pytest.raises(ValueError, match=r"pixel_reach: squared_reaches has shape \[6\]; it must be \[7\]"):
        torch.ops.diff_smoe_rasterization.pixel_reach(radii, values[:, 0], values[1:, 1])


def test_statistics_that_were_saved_for_a_backward_pass_are_not_changed_unseen(device):
    factor = torch.ones(4, requires_grad=True)
    for place in range(2):
        statistics = [torch.ones(4), torch.ones(4)]
        product = (factor * statistics[place]).sum()
        add_view(torch.ones(4, 3), torch.ones(4, dtype=torch.int32), *statistics)
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            product.backward()


@pytest.mark.parametrize("wrong", [None, 1, "a", [1.0]])
def test_what_is_no_tensor_is_named(wrong):
    row, radii = torch.ones(4), torch.ones(4, dtype=torch.int32)
    words = f"is of type {type(wrong).__name__}; it must be"
    for function, arguments in ((activate, {"opacities": row, "scales": row, "rotations": row}),
                                (add_view, {"dL_dmeans2D": row, "radii": radii, "gradient_sum": row,
                                            "view_count": row}), (divided, {"opacities": row, "copies": row})):
        for name in arguments:
            with pytest.raises(TypeError, match=f"{function.__name__}: {name} {words} a torch.Tensor"):
                function(**{**arguments, name: wrong})
    with pytest.raises(ValueError, match=r"divided: opacities has shape \[4\] and copies \[3\]; both must be"):
        divided(row, row[:3])
    with pytest.raises(TypeError, match=f"distCUDA2: points {words} a torch.Tensor"):
        distCUDA2(wrong)


@pytest.mark.parametrize("name", ["raw", "values", "dL_dvalues", "moments", "squares"])
def test_rotations_that_do_not_begin_where_a_quaternion_may_are_refused(name, device):
    """On a GPU a thread reads a quaternion at once."""
    shapes = ((7, 3), (7, 1), (7, 3), (7, 4))
    lists = {each: [torch.zeros(shape) for shape in shapes] for each in ("raw", "dL_dvalues", "moments", "squares")}
    lists["values"] = [torch.zeros(shape) for shape in shapes[1:]]
    radii = torch.zeros(7, dtype=torch.int32)

    def step():
        torch.ops.diff_smoe_rasterization.gaussian_adam(
            *(lists[each] for each in ("raw", "values", "dL_dvalues", "moments", "squares")), radii, [0.1] * 4,
            [1.0] * 4, 0.9, 0.999, 1e-15)

    step()
    lists[name][-1] = torch.zeros(29)[1:].view(7, 4)
    with pytest.raises(ValueError, match="rotations must begin at a multiple of a quaternion's size"):
        step()


def test_what_does_not_fit_is_refused(device):
    opacities, scales, rotations = raw_parameters(4, torch.float32)
    for arguments, error, text in (
            ((opacities[:, 0], scales, rotations), ValueError, r"opacities has shape \[4\]; it must be \[N, 1\]"),
            ((opacities, scales[:3], rotations), ValueError, r"scales has shape \[3, 3\]; it must be \[4, 3\]"),
            ((opacities, scales, rotations.double()), TypeError, "rotations is float64; it must be float32"),
            ((opacities.half(), scales, rotations), TypeError, "opacities is float16")):
        with pytest.raises(error, match="activate: " + text):
            activate(*arguments)
    with pytest.raises(TypeError, match="add_view: radii is int64; it must be int32"):
        add_view(torch.zeros(4, 3), torch.ones(4, dtype=torch.int64), torch.zeros(4), torch.zeros(4))
    with pytest.raises(ValueError, match=r"add_view: view_count has shape \[5\]; it must be \[4\]"):
        add_view(torch.zeros(4, 3), torch.ones(4, dtype=torch.int32), torch.zeros(4), torch.zeros(5))


set_inputs = torch.ops.diff_smoe_rasterization.set_inputs


def test_inputs_of_a_step_are_copied_and_written(device):
    """Bytes that fill no whole piece of 16, places where none may begin, an empty tensor, and a number alone."""
    bytes_ = (random_normal((3, 7, 11), 0).abs() * 80).to(torch.uint8)
    source = [bytes_, bytes_.flatten()[3:60], random_normal((4, 4), 1), random_normal((5,), 2).double(),
              torch.zeros(0), (random_normal((9,), 3) * 50).int()]
    room = torch.zeros(100, dtype=torch.uint8)
    to = [torch.zeros_like(source[0]), room[5:62], *(torch.zeros_like(tensor) for tensor in source[2:])]
    numbers = torch.zeros(6)
    set_inputs(to, source, numbers[1:4], [0.5, 4095.0, 1 / 3])
    assert all(torch.equal(copy, tensor) for copy, tensor in zip(to, source))
    assert torch.equal(numbers, torch.tensor([0, 0.5, 4095, 1 / 3, 0, 0]))
    assert not room[:5].any() and not room[62:].any()
    set_inputs([], [], numbers[:1], [7.0])
    assert numbers[0] == 7 and numbers[1] == 0.5


@pytest.mark.parametrize("to, source, new, error, text", [
    ([torch.zeros(3)], [], [], ValueError, "source has length 0; it must be 1"),
    ([torch.zeros(3)], [torch.zeros(4)], [], ValueError, r"to\[0\] has shape \[3\]; it must be \[4\]"),
    ([torch.zeros(3)], [torch.zeros(3).double()], [], TypeError, r"to\[0\] is float32; it must be float64"),
    ([torch.zeros(3).bool()], [torch.zeros(3).bool()], [], TypeError, r"source\[0\] is bool; it must be uint8"),
    ([torch.zeros(1)] * 9, [torch.zeros(1)] * 9, [], ValueError, "to has length 9; it must be at most 8"),
    ([], [], [1.0] * 33, ValueError, "new_numbers has length 33; it must be at most 32"),
    ([], [], [1.0], ValueError, r"numbers has shape \[0\]; it must be \[1\]")])
def test_inputs_that_do_not_fit_are_refused(to, source, new, error, text):
    with pytest.raises(error, match="set_inputs: " + text):
        set_inputs(to, source, torch.zeros(0), new)


def test_a_step_of_the_gate_is_one_of_adam_on_its_logarithm(device):
    bound, limit = 0.25, 1.0
    logarithm, gate, moment, square = torch.full((1,), -0.5), torch.zeros(1), torch.zeros(1), torch.zeros(1)
    p = logarithm.double().requires_grad_()
    adam = FusedAdam([p], lr=0.3)
    for step in range(1, 9):
        gradient = torch.full((1,), -0.5 - step / 4)
        (gradient.double() * (bound + p.exp())).sum().backward()
        adam.step()
        adam.zero_grad()
        with torch.no_grad():
            p.clamp_(-limit, limit)
        torch.ops.diff_smoe_rasterization.gate_adam(
            logarithm, moment, square, gate, gradient, 0.3 / (1 - 0.9**step), (1 - 0.999**step) ** -0.5, 0.9, 0.999,
            1e-8, bound, limit)
        # A few roundings in each of the steps.
        torch.testing.assert_close(logarithm.double(), p.detach(), rtol=0, atol=1e-5)
        torch.testing.assert_close(gate.double(), bound + p.detach().exp(), rtol=1e-5, atol=0)
    assert float(logarithm) == limit, "it has come to its bound"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_gradient_of_the_gate_that_is_not_finite_counts_as_0(device, value):
    """Its moments fade as by a gradient of 0, so that the next step is finite."""
    found = []
    for gradient in (value, 0.0):
        state = [torch.full((1,), start) for start in (-0.5, 0.25, 0.125, 0.0)]
        torch.ops.diff_smoe_rasterization.gate_adam(*state, torch.full((1,), gradient), 0.1, 1.0, 0.9, 0.999, 1e-8, 0.0,
                                                    80.0)
        found.append(torch.cat(state))
    assert torch.equal(*found) and float(found[1][1]) == pytest.approx(0.9 * 0.25)


gather_rows = torch.ops.diff_smoe_rasterization.gather_rows


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 3000])
def test_rows_are_those_of_indexing(device, dtype, count):
    """Widths below and above a block's 1024 numbers, and more tensors than one launch holds."""
    tensors = [random_normal((700, *shape), i, dtype) for i, shape in enumerate([(3,), (1,), (15, 3), (1500,), ()] * 4)]
    rows = (random_normal((count,), 99).abs() * 1e6).long() % 700
    for tensor, taken in zip(tensors, gather_rows(tensors, rows)):
        assert torch.equal(taken, tensor[rows])


def test_rows_without_numbers(device):
    (taken,) = gather_rows([torch.zeros(4, 0, 3)], torch.tensor([2, 0, 1]))
    assert taken.shape == (3, 0, 3)


def test_rows_that_do_not_fit_are_refused(device):
    with pytest.raises(TypeError, match="rows is int32"):
        gather_rows([torch.zeros(4)], torch.zeros(2, dtype=torch.int32))
    with pytest.raises(TypeError, match=r"tensors\[1\] is float64"):
        gather_rows([torch.zeros(4), torch.zeros(4, dtype=torch.float64)], torch.tensor([0]))
    with pytest.raises(ValueError, match=r"tensors\[1\] has 3 rows; it must have 4, as tensors\[0\] has"):
        gather_rows([torch.zeros(4), torch.zeros(3)], torch.tensor([3]))


@pytest.mark.parametrize("rows, ends", [([3, -1, 0], "from -1 to 3"), ([0, 4], "from 0 to 4"), ([2 ** 40], "")])
def test_rows_that_are_not_there_are_refused(rows, ends, device):
    with pytest.raises(IndexError, match=f"gather_rows: rows has indices {ends}.*; the tensors have 4 rows"):
        gather_rows([torch.zeros(4, 3), torch.zeros(4)], torch.tensor(rows))
