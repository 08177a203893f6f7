"""--modernise: where its rules are applied, and the stand-ins that it brings in."""
from __future__ import annotations

import itertools
import math
import urllib.error

import pytest
import torch

pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")

from diff_smoe_rasterization import patches  # noqa: E402
from diff_smoe_rasterization.patches import modernise, runtime  # noqa: E402
from checkouts import make_checkout  # noqa: E402
from test_patch_engine import TRAIN, make, snapshot  # noqa: E402


def test_rules_are_applied_on_request_and_reported(tmp_path):
    make(tmp_path, {"submodules/grid/setup.py": "flags = ['-O2', '-std=c++14']\n"})
    before = snapshot(tmp_path)
    patches.apply(tmp_path)
    assert "weights_only" not in (tmp_path / "train.py").read_text()
    patches.revert(tmp_path)
    notes = patches.apply(tmp_path, modernise=True).notes
    applied = [rule for rule in modernise.RULES if rule.name in ("checkpoint-load", "cpp-standard")]
    assert len(notes) == len(applied) + 1
    for note, rule in zip(notes, applied):
        assert note.startswith(f"modernise {rule.name}: applied in ") and rule.reason in note
    assert notes[-1].startswith("modernise: skipped, nothing matches: simple-knn, ")
    assert notes[-1].count(", ") == len(modernise.RULES) - len(applied)
    assert (tmp_path / "submodules/grid/setup.py").read_text() == "flags = ['-O2']\n"
    assert "weights_only" not in TRAIN and "weights_only=False" in (tmp_path / "train.py").read_text()
    patches.revert(tmp_path)
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize("name", ["hac", "hac-plus"])
def test_anchors_are_made_in_unique_cells_of_ours(name, tmp_path):
    checkout = make_checkout(name, tmp_path / name)
    before = (checkout / "scene/anchors.py").read_text()
    planned = patches.apply(checkout, modernise=True)
    assert [rule.files for rule in planned.requested if rule.rule == "unique-rows"] == [("scene/anchors.py",)]
    after = (checkout / "scene/anchors.py").read_text()
    assert before.count("torch.unique(") == after.count(" unique_rows(") == 1 and "torch.unique(" not in after
    assert before.count(".unique(dim=0)") == after.count(".unique(dim=0)") == 1  # of floats, by the tensor's method
    patches.revert(checkout)
    assert (checkout / "scene/anchors.py").read_text() == before


def test_a_module_that_is_absent_is_missed_when_it_is_used():
    assert runtime.optional_import("math").pi > 3
    absent = runtime.optional_import("there_is_no_such_module")
    with pytest.raises(ImportError, match="there_is_no_such_module"):
        absent.login()


def test_what_is_deferred_is_made_once():
    made = []
    call = runtime.deferred(lambda: made.append(1) or (lambda value: 2 * value))
    assert made == [] and call(3) == 6 and call(4) == 8 and made == [1]


@pytest.mark.parametrize("shape, at_once", [((7, 3, 3), 3), ((2, 4, 3, 3), 3), ((7, 3, 3), 7), ((3, 3), 1),
                                            ((0, 3, 3), 3)])
def test_eigenvectors_in_parts_are_those_of_all_at_once(monkeypatch, shape, at_once):
    monkeypatch.setattr(runtime, "EIGH_AT_ONCE", at_once)
    matrices = torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    found, expected = runtime.eigh_in_parts(matrices, UPLO="U"), torch.linalg.eigh(matrices, UPLO="U")
    assert torch.equal(found.eigenvalues, expected.eigenvalues)
    assert torch.equal(found.eigenvectors, expected.eigenvectors)
    gradient, expected_gradient = (torch.autograd.grad((result[0] ** 2).sum(), matrices)[0]
                                   for result in (found, expected))
    torch.testing.assert_close(gradient, expected_gradient)


def same_unique(rows, **keywords):
    """Asserts that unique_rows returns what torch.unique(dim=0) does."""
    for inverse, counts in itertools.product((False, True), repeat=2):
        found, expected = (unique(rows, return_inverse=inverse, return_counts=counts, dim=0, **keywords)
                           for unique in (runtime.unique_rows, torch.unique))
        assert isinstance(found, tuple) == isinstance(expected, tuple) == (inverse or counts)
        pairs = list(zip(found, expected)) if isinstance(found, tuple) else [(found, expected)]
        assert len(pairs) == 1 + inverse + counts
        for one, other in pairs:
            assert one.dtype == other.dtype and torch.equal(one, other)


INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


@pytest.mark.parametrize("dtype", INTEGERS)
@pytest.mark.parametrize("shape", [(1, 3), (2000, 3), (500, 1), (500, 4), (300,), (200, 2, 2), (0, 3), (0,)])
def test_unique_rows_are_those_of_torch(dtype, shape):
    generator = torch.Generator().manual_seed(0)
    ends = torch.iinfo(dtype)
    for low, high in ((0, 1), (0, 3), (max(-90, ends.min), 90)):  # all rows equal, many, few
        same_unique(torch.randint(low, high, shape, generator=generator, dtype=dtype))
    extremes = torch.tensor([ends.min, ends.min + 1, 0, 1, ends.max - 1, ends.max], dtype=dtype)
    same_unique(extremes[torch.randint(0, 6, shape, generator=generator)])


def test_unique_rows_of_columns_whose_distinct_values_multiply_to_more_than_int64_takes():
    rows = torch.randint(-2**63, 2**63 - 1, (3000, 6), generator=torch.Generator().manual_seed(0))
    rows = torch.cat([rows, rows[:1000]])
    assert math.prod(len(column.unique()) for column in rows.unbind(1)) > 2**63
    same_unique(rows)


@pytest.mark.parametrize("rows", [torch.tensor([[2.5, 1.0], [0.0, -0.0], [2.5, 1.0]]), torch.tensor([0.5, 0.5, -3]),
                                  torch.tensor([[True, False], [False, True], [True, False]]),
                                  torch.arange(12).reshape(3, 4).t() % 2])
def test_unique_rows_of_other_tensors(rows):
    same_unique(rows)
    same_unique(rows, sorted=False)


def test_unique_rows_refuses_what_torch_does():
    for input in (torch.zeros(3, 0, dtype=torch.int32), torch.zeros(2, 0, 3)):
        for unique in (runtime.unique_rows, torch.unique):
            with pytest.raises(RuntimeError, match="0 sized dimensions"):
                unique(input, dim=0)


def test_rows_of_integers_are_not_given_to_the_unique_that_may_fail(monkeypatch):
    unique, given = torch.unique, []
    monkeypatch.setattr(torch, "unique", lambda input, *words, dim=None, **keywords: (
        given.append((input.dim(), dim)), unique(input, *words, dim=dim, **keywords))[1])
    runtime.unique_rows(torch.tensor([[3, 1], [2, 1]]), dim=0)
    assert given == [(1, None)] * 4


def test_a_metric_is_nan_where_its_weights_cannot_be_had():
    calls = []

    @runtime.nan_without_network
    def metric(value):
        calls.append(value)
        if value > 1:
            raise urllib.error.URLError("no route to host")
        return torch.tensor(value)

    assert metric(1.0) == 1.0
    with pytest.warns(UserWarning, match="no route to host"):
        assert torch.isnan(metric(2.0))
    assert torch.isnan(metric(1.0)) and calls == [1.0, 2.0]

    absent = runtime.optional_import("there_is_no_such_module")
    with pytest.warns(UserWarning, match="there_is_no_such_module"):
        assert torch.isnan(runtime.nan_without_network(runtime.deferred(lambda: absent.LPIPS()))(1.0))

    @runtime.nan_without_network
    def wrong(value):
        raise ValueError("a bug is no missing network")

    with pytest.raises(ValueError):
        wrong(1.0)
