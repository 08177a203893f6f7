"""Each rule of --modernise and --fuse on a few lines."""
from __future__ import annotations

import pytest

from diff_smoe_rasterization.patches.rules import ON_REQUEST
from diff_smoe_rasterization.patches.source import Source
from diff_smoe_rasterization.patches.trainers import RUNTIME

RULES = {rule.name: rule for rules in ON_REQUEST.values() for rule in rules}
BEFORE_AND_AFTER = [
    ("checkpoint-load", "a = torch.load(path)  # all\n", "a = torch.load(path, weights_only=False)  # all\n"),
    ("checkpoint-load", "torch.load(\n    path,\n)\n", "torch.load(\n    path, weights_only=False,\n)\n"),
    ("checkpoint-load", "torch.load(path, weights_only=True)\n", None),
    ("checkpoint-load", "a = f(torch.load((path ) ))\n", "a = f(torch.load((path ), weights_only=False ))\n"),
    ("simple-knn", "from simple_knn._C import distCUDA2\n", "from diff_smoe_rasterization import distCUDA2\n"),
    ("simple-knn", "from simple_knn._C import other\n", None),
    ("fused-ssim", "try:\n    from fused_ssim import fused_ssim as fast\nexcept: pass\n",
     "try:\n    from diff_smoe_rasterization import fused_ssim as fast\nexcept: pass\n"),
    ("torch-scatter", "from torch_scatter import scatter_max\n",
     "from diff_smoe_rasterization.integrations.torch_scatter import scatter_max\n"),
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
    ("lpips-when-used", "if __name__ == '__main__':\n    f = lpips.LPIPS().to(device)\n",  # metrics.py of Scaffold-GS
     f"if __name__ == '__main__':\n    from {RUNTIME} import deferred, nan_without_network\n"
     "    f = nan_without_network(deferred(lambda: lpips.LPIPS().to(device)))\n"),
    ("lpips-when-used", "def f():\n    g = lpips.LPIPS(net='vgg')\n", None),
    ("lpips-offline", "import torch\n\ndef lpips(x, y):\n    return x\n",
     f"import torch\nfrom {RUNTIME} import nan_without_network\n\n"
     "@nan_without_network\ndef lpips(x, y):\n    return x\n"),
    ("blender-images", "np.array(a * 255.0, dtype=np.byte)\n", "np.array(a * 255.0, dtype=np.uint8)\n"),
    ("numpy-types", "levels = a.astype(np.int)  # of the octree\n", "levels = a.astype(int)  # of the octree\n"),
    ("numpy-types", "a = f'{numpy.zeros(3, numpy.float)} é' + np.int\n", "a = f'{numpy.zeros(3, float)} é' + int\n"),
    ("numpy-types", "np.int32, np.float64, np.bool_, np.integer, mine.np.int, torch.int\n", None),
    ("eigh-in-parts", "import torch\nS, R = torch.linalg.eigh(cov, UPLO='U')\n",
     f"import torch\nfrom {RUNTIME} import eigh_in_parts\n\nS, R = eigh_in_parts(cov, UPLO='U')\n"),
    ("eigh-in-parts", "torch.linalg.eigh(cov, out=both)\n", None),
    ("unique-rows", "import torch\na, b = torch.unique(c, return_inverse=True, dim=0)  # rows\n",
     f"import torch\nfrom {RUNTIME} import unique_rows\n\na, b = unique_rows(c, return_inverse=True, dim=0)  # rows\n"),
    ("unique-rows", "a = torch.unique(\n    c, dim=0,\n    sorted=False, return_counts=True)\n",
     f"from {RUNTIME} import unique_rows\n\na = unique_rows(\n    c, dim=0,\n    sorted=False, return_counts=True)\n"),
    ("unique-rows", "torch.unique(c, dim=1)\ntorch.unique(c, dim=-1)\ntorch.unique(c, dim=d)\n", None),
    ("unique-rows", "torch.unique(c, dim=0, return_index=True)\n", None),
    ("unique-rows", "np.unique(c, dim=0)  # no torch.unique(c, dim=0)\ntorch.unique_consecutive(c, dim=0)\n", None),
    ("cpp-standard", "f = [\n    '-O3', '-std=c++14',\n    '-U',\n]\n", "f = [\n    '-O3',\n    '-U',\n]\n"),
    ("cpp-standard", "f = ['-std=c++14', '-O3']\n", "f = ['-O3']\n"),
    ("cpp-standard", "f = ['-O3', '-std=c++14']\n", "f = ['-O3']\n"),
    ("fused-loss", "import torch\n\ndef ssim(img1, img2, window_size=11, size_average=True):  # mean\n    return 1\n",
     f"import torch\nfrom {RUNTIME} import fused_where_equal\n\n"
     "@fused_where_equal\ndef ssim(img1, img2, window_size=11, size_average=True):  # mean\n    return 1\n"),
    ("fused-loss", "class Metrics:\n    def ssim(self, img1, img2):\n        return 1\n", None),
    ("fused-loss", "@torch.jit.script\ndef ssim(img1, img2):\n    return 1\n", None),
    ("fused-adam", "import torch\noptimizer = torch.optim.Adam(l, lr=0.0, eps=1e-15)  # all\n",
     "import torch\nfrom diff_smoe_rasterization import FusedAdam\n\n"
     "optimizer = FusedAdam(l, lr=0.0, eps=1e-15)  # all\n"),
    ("fused-adam", "'''A model.'''\nfrom diff_smoe_rasterization import (distCUDA2)\na = torch.optim.Adam(l)\n",
     "'''A model.'''\nfrom diff_smoe_rasterization import (FusedAdam, distCUDA2)\na = FusedAdam(l)\n"),
    ("fused-adam", "from apex.optimizers import FusedAdam\na = FusedAdam(l) if fast else torch.optim.Adam(l)\n", None),
    ("fused-adam", "class FusedAdam(torch.optim.Adam): pass\na = torch.optim.Adam(l)\n", None),
    ("fused-adam", "FusedAdam = torch.optim.SGD\na = torch.optim.Adam(l)\n", None),
    ("fused-adam", "import apex.optimizers as FusedAdam\na = torch.optim.Adam(l)\n", None),
    ("fused-adam", "torch.optim.Adam(l, lr=0.0, weight_decay=0.1)\ntorch.optim.AdamW(l)\n", None),
    ("fused-adam", "torch.optim.Adam(l, 0.1, (0.9, 0.99), 1e-8, 0.01)\n", None),
    ("fused-adam", "torch.optim.Adam(l, **options)\ntorch.optim.Adam(*arguments)\n", None),
]


@pytest.mark.parametrize("name, before, after", BEFORE_AND_AFTER)
def test_what_a_rule_changes(name, before, after):
    rule = RULES[name]
    assert any(hint in before for hint in rule.hints)
    changed = rule.change(Source("x.py", before.encode()))
    assert (changed and changed.decode()) == after
    assert changed is None or rule.change(Source("x.py", changed)) is None  # it is not applied twice


def test_every_rule_is_tried_above():
    assert {name for name, _, after in BEFORE_AND_AFTER if after} == set(RULES)
