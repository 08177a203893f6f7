"""What the build reads and what it installs."""
from __future__ import annotations

import importlib.metadata
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import diff_smoe_rasterization
from diff_smoe_rasterization import extension

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "diff_smoe_rasterization"
INSTALLED = Path(diff_smoe_rasterization.__file__).parent


def listed_files():
    lines = (line.partition("#")[0].split() for line in (ROOT / "sources.txt").read_text().splitlines())
    return [name for words in lines if words and words[0] != "flags" for name in words[1:]]


def test_sources_lists_every_compiled_file_once():
    files = [path.relative_to(SOURCE).as_posix() for end in ("cpp", "cu") for path in SOURCE.rglob(f"*.{end}")]
    assert files and sorted(listed_files()) == sorted(files)


def test_the_package_brings_every_public_header():
    names = {path.name for path in (SOURCE / "include" / "dsmoe").iterdir()}
    assert "rasterize.h" in names
    assert names == {path.name for path in (INSTALLED / "include" / "dsmoe").iterdir()}


def test_the_build_wrote_down_its_torch():
    info = pytest.importorskip("diff_smoe_rasterization._build_info", reason="not built by setup.py")
    assert info.TORCH_VERSION == torch.__version__
    assert info.WITHOUT_CUDA_BECAUSE or "cuda" in extension.BACKENDS


@pytest.mark.skipif(INSTALLED == SOURCE, reason="runs from the source folder; nothing is installed")
def test_installed_version_is_the_source_version():
    assert importlib.metadata.version("diff_smoe_rasterization") == diff_smoe_rasterization.__version__


def test_extension_of_another_torch_explains_itself(tmp_path):
    """A stale build must say so: nothing of torch's own error for it names the cause."""
    package = tmp_path / "diff_smoe_rasterization"
    package.mkdir()
    for path in INSTALLED.iterdir():
        if path.name != "_build_info.py" and path.name != "__pycache__":
            (package / path.name).symlink_to(path)
    (package / "_build_info.py").write_text("TORCH_VERSION = '0.4.1'\nWITHOUT_CUDA_BECAUSE = ''\n")
    run = subprocess.run([sys.executable, "-c", "import diff_smoe_rasterization.rasterizer"], cwd=str(tmp_path),
                         stdout=subprocess.PIPE, stderr=subprocess.PIPE, universal_newlines=True)
    assert run.returncode != 0
    for word in ("ImportError", "built against torch 0.4.1", f"torch {torch.__version__} is running", "pip install"):
        assert word in run.stderr
