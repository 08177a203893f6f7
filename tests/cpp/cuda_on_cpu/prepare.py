"""Makes C++ of CUDA: prepare.py FOLDER FILE... writes what a C++ compiler can compile with emulator.h.

Each file keeps its path from the repository's root, below FOLDER. Compilers and debuggers name the original one.
"""

import re
import sys
from pathlib import Path


def launch(match):
    """kernel<<<grid, threads, ...>>>(arguments): each thread calls the kernel."""
    kernel, how, arguments = match.groups()
    return f"::emulator::launch([&] {{ {kernel}({arguments}); }}, {how});"


def shared(match):
    """Shared memory is static, because blocks run one after another."""
    declared = match[1]
    names = re.findall(r"(\w+)(?:\[[^\]]*\])*(?=,|$)", re.sub("<.*>", "", declared))
    return f"static {declared}; ::emulator::begin_shared({', '.join(names)});"


def dynamic_shared(match):
    return f"auto* {match[2]} = reinterpret_cast<{match[1]}*>(::emulator::dynamic_shared);"


def instruction(match):
    """PTX becomes a function with the instruction's name, which gets all operands in their order."""
    name = re.sub(r"\W", "_", match[1])
    operands = re.sub(r'"[^"]*"\s*(?=\()', "", match[2].replace('"memory"', "")).replace(":", ",")
    return f"::emulator::{name}({operands.strip(' ,')});"


def prepare(text):
    text = re.sub(r"^DSMOE_INSTANTIATE\(double\)$", "", text, flags=re.MULTILINE)  # half of the compiler's time
    text = re.sub(r"(\w+(?:<[^<>;]*>)?)\s*<<<([^;]*)>>>\(([^;]*)\);", launch, text)
    text = re.sub(r"extern __shared__ (\w+) (\w+)\[\];", dynamic_shared, text)
    text = re.sub(r"__shared__ ([^;]*);", shared, text)
    return re.sub(r'\basm(?: volatile)?\(\s*"([\w.]+)[^"]*"(?:\s*"[^"]*")*\s*:([^;]*)\);', instruction, text)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    for name in sys.argv[2:]:
        source = Path(name).resolve()
        target = folder / source.relative_to(Path(__file__).resolve().parents[3])
        target.parent.mkdir(parents=True, exist_ok=True)
        text = f'#line 1 "{source}"\n' + prepare(source.read_text())
        if not target.exists() or target.read_text() != text:
            target.write_text(text)
