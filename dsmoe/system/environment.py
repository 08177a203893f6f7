"""What a number was measured on: machine, versions, backends."""
from __future__ import annotations

import os
import platform
from typing import Any, Dict

import numpy as np
import torch

from diff_smoe_rasterization._version import __version__


def processor_name() -> str:
    """The processor's model name as the system gives it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            for line in file:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def machine(device: str) -> str:
    """One line: the processor or GPU that does the work, and how many threads it uses."""
    if device != "cpu" and torch.cuda.is_available():
        return torch.cuda.get_device_name()
    return f"{processor_name()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads"


def versions() -> Dict[str, str]:
    """Versions that can change a result."""
    return {"diff_smoe_rasterization": __version__, "torch": torch.__version__, "numpy": np.__version__,
            "python": platform.python_version()}


def extension_info() -> Dict[str, Any]:
    """`build_info()` of the compiled extension. Raises ImportError if it is not built."""
    from diff_smoe_rasterization import build_info

    return dict(build_info())


def describe() -> str:
    """What `dsmoe info` prints; says what is missing if the extension is not usable."""
    lines = {**versions(), "processor": f"{processor_name()}, {os.cpu_count()} cores"}
    try:
        info = extension_info()
    except ImportError as error:
        lines["extension"] = f"not usable: {error}"
    else:
        reason = info.get("without_cuda_because")
        without = f"no cuda ({reason})" if reason else "no cuda"
        lines["backends"] = "cpu, cuda" if info.get("cuda_built") else f"cpu; {without}"
        lines["SIMD level"] = info.get("simd_level", "unknown")
        lines["threads"] = info.get("num_threads", torch.get_num_threads())
        lines["compiler"] = info.get("compiler", "unknown")
        lines["built with torch"] = info.get("torch_built_with", "unknown")
    gpus = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    lines["GPU"] = ", ".join(gpus) if gpus else "none that torch can use"
    if gpus and lines.get("backends", "").startswith("cpu;"):
        lines["GPU"] += "; NOT USED: this build has no kernels for it. DSMOE_BUILD_CUDA=1 pip install . builds them"
    return "\n".join(f"{name:<26}{text}" for name, text in lines.items())
