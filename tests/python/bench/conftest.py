"""The small suite as a fixture; what is skipped without the packages of benchmarks."""
import importlib.util
import sys
from pathlib import Path

import pytest
from bench_commands import tiny_suite
from tiny_scene import one_thread, tiny_scene  # noqa: F401

LACKING = [name for name in ("yaml", "pydantic", "jinja2", "matplotlib") if importlib.util.find_spec(name) is None]
WITHOUT_THEM = ("test_measure",)
sys.path.append(str(Path(__file__).resolve().parents[1] / "patches"))  # the small trainer of those tests


class Skipped(pytest.Module):
    """A module that cannot be imported."""

    def collect(self):
        pytest.skip(f"without {', '.join(LACKING)}: pip install '.[bench]'", allow_module_level=True)


def pytest_pycollect_makemodule(module_path, parent):
    if LACKING and module_path.stem not in WITHOUT_THEM:
        return Skipped.from_parent(parent, path=module_path)
    return None


@pytest.fixture
def content(tiny_scene):
    return tiny_suite(tiny_scene)
