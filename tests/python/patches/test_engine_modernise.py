"""Each rule of --modernise on a few lines, and the stand-ins that it brings in."""
from __future__ import annotations

import urllib.error

import pytest
import torch

cst = pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")

from diff_smoe_rasterization import patches  # noqa: E402
from diff_smoe_rasterization.patches import modernise, runtime  # noqa: E402
from diff_smoe_rasterization.patches.rules import RUNTIME  # noqa: E402
from test_patch_engine import TRAIN, make, snapshot  # noqa: E402

RULES = {rule.name: rule for rule in modernise.RULES}
BEFORE_AND_AFTER = [
    ("checkpoint-load", "a = torch.load(path)  # all\n", "a = torch.load(path, weights_only=False)  # all\n"),
    ("checkpoint-load", "torch.load(\n    path,\n)\n", "torch.load(\n    path, weights_only=False,\n)\n"),
    ("checkpoint-load", "torch.load(path, weights_only=True)\n", None),
    ("simple-knn", "from simple_knn._C import distCUDA2\n", "from diff_smoe_rasterization import distCUDA2\n"),
    ("simple-knn", "from simple_knn._C import other\n", None),
    ("fused-ssim", "try:\n    from fused_ssim import fused_ssim as fast\nexcept: pass\n",
     "try:\n    from diff_smoe_rasterization import fused_ssim as fast\nexcept: pass\n"),
    ("torch-scatter", "from torch_scatter import scatter_max\n",
     "from diff_smoe_rasterization.integrations.torch_scatter import scatter_max\n"),
    ("torch-scatter", "from torch_scatter import scatter, segment_csr\n", None),
    ("weighted-distance", "from weighted_distance._C import weightedDistance\n",
     "from diff_smoe_rasterization.integrations.weighted_distance import weightedDistance\n"),
    ("optional-import", "# logs\nimport wandb  # online\n",
     f'# logs\nfrom {RUNTIME} import optional_import\nwandb = optional_import("wandb")  # online\n'),
    ("optional-import", "def f():\n    import wandb\n", None),
    ("optional-import", "try:\n    import wandb\nexcept ImportError:\n    wandb = None\n", None),
    ("lpips-when-used", "f = lpips.LPIPS(net='vgg').to('cuda')\n",
     f"from {RUNTIME} import deferred, nan_without_network\n"
     "f = nan_without_network(deferred(lambda: lpips.LPIPS(net='vgg').to('cuda')))\n"),
    ("lpips-when-used", "f = lpips.LPIPS()\n", f"from {RUNTIME} import deferred, nan_without_network\n"
     "f = nan_without_network(deferred(lambda: lpips.LPIPS()))\n"),
    ("lpips-when-used", "def f():\n    g = lpips.LPIPS(net='vgg')\n", None),
    ("lpips-offline", "import torch\n\ndef lpips(x, y):\n    return x\n",
     f"import torch\nfrom {RUNTIME} import nan_without_network\n\n"
     "@nan_without_network\ndef lpips(x, y):\n    return x\n"),
    ("blender-images", "np.array(a * 255.0, dtype=np.byte)\n", "np.array(a * 255.0, dtype=np.uint8)\n"),
    ("eigh-in-parts", "import torch\nS, R = torch.linalg.eigh(cov, UPLO='U')\n",
     f"import torch\nfrom {RUNTIME} import eigh_in_parts\nS, R = eigh_in_parts(cov, UPLO='U')\n"),
    ("eigh-in-parts", "torch.linalg.eigh(cov, out=both)\n", None),
    ("cpp-standard", "f = [\n    '-O3', '-std=c++14',\n    '-U',\n]\n", "f = [\n    '-O3',\n    '-U',\n]\n"),
    ("cpp-standard", "f = ['-std=c++14', '-O3']\n", "f = ['-O3']\n"),
    ("cpp-standard", "f = ['-O3', '-std=c++14']\n", "f = ['-O3']\n"),
]


@pytest.mark.parametrize("name, before, after", BEFORE_AND_AFTER)
def test_what_a_rule_changes(name, before, after):
    assert RULES[name].looks_at(before.encode())
    outcome = modernise.run(RULES[name], cst.parse_module(before))
    assert outcome.tree.code == (before if after is None else after)
    assert outcome.pending == (after is not None)
    assert modernise.run(RULES[name], outcome.tree).pending == 0  # by which it is seen that a rule is applied


def test_every_rule_is_tried_above():
    assert {name for name, _, after in BEFORE_AND_AFTER if after} == set(RULES)


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
    assert notes[-1].count(", ") == len(RULES) - len(applied)
    assert (tmp_path / "submodules/grid/setup.py").read_text() == "flags = ['-O2']\n"
    assert "weights_only" not in TRAIN and "weights_only=False" in (tmp_path / "train.py").read_text()
    patches.revert(tmp_path)
    assert snapshot(tmp_path) == before


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
