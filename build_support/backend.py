"""The build backend that pyproject.toml names: setuptools, plus the choice of the torch to build against.

The extension only loads with the torch release that it was built against. An isolated build hides the
caller's torch, so it would get the newest one from the index and the extension would not load later.
Hence the caller's torch is put back in sight; only if there is none is one asked for.
"""
import importlib.util
import re
import site
import sys

from setuptools.build_meta import *  # noqa: F401,F403

if importlib.util.find_spec("torch") is None:
    sys.path += site.getsitepackages() + [site.getusersitepackages()]


def refuse_too_old(python, torch):
    """Stops with the reason, which pip shows: it would otherwise fetch gigabytes first, or replace the torch."""
    found = re.match(r"(\d+)\.(\d+)", torch or "")
    if python < (3, 8):
        too_old = "this is Python {}.{}".format(*python)
    elif found and tuple(map(int, found.groups())) < (1, 13):
        too_old = "here is PyTorch " + torch
    else:
        return
    sys.exit("error: diff_smoe_rasterization needs Python 3.8 and PyTorch 1.13, or newer ones, and " + too_old
             + ". The environments that Taming 3DGS, HAC and HAC++ name are too old; docs/trainers.md has one in which "
               "they train")


def get_requires_for_build_wheel(config_settings=None):
    torch = None
    if sys.version_info >= (3, 8):  # noqa: UP036 (an older one gets this far)
        from importlib import metadata

        torch = next((found.version for found in metadata.distributions(name="torch")), None)
    refuse_too_old(sys.version_info[:2], torch)
    return [] if importlib.util.find_spec("torch") else ["torch"]


get_requires_for_build_editable = get_requires_for_build_wheel


def get_requires_for_build_sdist(config_settings=None):
    return []
