"""The `dsmoe` command in a process that file modes bind, also where the tests run as the superuser."""
from __future__ import annotations

import ctypes
import os
import subprocess
import sys

import diff_smoe_rasterization

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 24, 1, 2  # of Linux
PACKAGE = os.path.dirname(os.path.dirname(os.path.abspath(diff_smoe_rasterization.__file__)))


def dsmoe(*words):
    """Runs it; returns the finished process, with `returncode`, `stdout` and `stderr`."""
    prctl = ctypes.CDLL(None).prctl
    return subprocess.run([sys.executable, "-m", "dsmoe", *map(str, words)], stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, universal_newlines=True,
                          env={**os.environ, "PYTHONPATH": PACKAGE},
                          preexec_fn=lambda: [prctl(PR_CAPBSET_DROP, capability, 0, 0, 0) for capability in (
                              CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH)])
