"""What a number was measured on: machine, versions, backends."""
from __future__ import annotations

import os
import platform
from typing import Any, Dict

import numpy as np
import torch

from .._version import __version__


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
    """`build_info()` of the compiled extension. Raises ImportError where it is not built."""
    from .. import build_info

    return dict(build_info())


def describe() -> str:
    """What `dsmoe info` prints; says what is missing where the extension is not built."""
    lines = [f"{name:<26}{version}" for name, version in versions().items()]
    lines.append(f"{'processor':<26}{processor_name()}, {os.cpu_count()} cores")
    lines.append(f"{'torch threads':<26}{torch.get_num_threads()}")
    try:
        info = extension_info()
    except ImportError as error:
        lines.append(f"{'extension':<26}not usable: {error}")
    else:
        cuda = "built" if info.pop("cuda_built", False) else "not built"
        info.pop("version", None)
        lines.append(f"{'backends':<26}cpu; cuda: {cuda}")
        for name, label in (("simd", "SIMD level"), ("simd_available", "SIMD levels here"),
                            ("num_threads", "rasterizer threads"), ("compiler", "compiler"),
                            ("torch_built_with", "built with torch")):
            if name in info:
                value = info[name]
                text = ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
                lines.append(f"{label:<26}{text}")
    gpus = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    lines.append(f"{'GPU':<26}{', '.join(gpus) if gpus else 'none that torch can use'}")
    return "\n".join(lines)
