"""The build backend that pyproject.toml names: setuptools, plus the choice of the torch to build against.

The extension only loads with the torch release that it was built against. An isolated build hides the
caller's torch, so it would get the newest one from the index and the extension would not load later.
Hence the caller's torch is put back in sight; only if there is none is one asked for.
"""
import importlib.util
import site
import sys

from setuptools.build_meta import *  # noqa: F401,F403

if importlib.util.find_spec("torch") is None:
    sys.path += site.getsitepackages() + [site.getusersitepackages()]


def get_requires_for_build_wheel(config_settings=None):
    return [] if importlib.util.find_spec("torch") else ["torch"]


get_requires_for_build_editable = get_requires_for_build_wheel


def get_requires_for_build_sdist(config_settings=None):
    return []
