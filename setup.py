"""Builds libdsmoe.so, which needs no Python, and the extension _C over it. Metadata: pyproject.toml; files and compiler
flags: sources.txt.

Environment: DSMOE_BUILD_CUDA=auto|0|1 (auto: where torch and the machine have CUDA; unset: where also a GPU is seen, or
cards are named), TORCH_CUDA_ARCH_LIST, MAX_JOBS; DSMOE_CUDA_ARCH=all compiles for every card where none is seen;
DSMOE_CORE_FOLDER=DIR links the libraries that CMake has built in DIR (libdsmoe_core.a, libdsmoe_io.a, libdsmoe_cuda.a)
in place of compiling their sources once more; DSMOE_STABLE_ABI=1 makes _C by LibTorch's stable ABI and Python's limited
API: it loads with every PyTorch from 2.11 on, and libdsmoe.so has no ops for C++.
"""
import os
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import setuptools

ROOT = Path(__file__).resolve().parent
PACKAGE = "diff_smoe_rasterization"
LIBRARY = "libdsmoe"
# Where a C++ program finds what libdsmoe.so needs. Python has loaded it before.
LIBRARY_PATHS = ("$ORIGIN/../torch/lib", "$ORIGIN/../nvidia/cu13/lib", "$ORIGIN/../nvidia/cuda_runtime/lib")
# What is compiled for where no card is seen. A kernel runs on later cards of the same major number too; cards after the
# last compile its PTX when they first run it. EVERY_CARD: what torch's own builds are for, and 11.0. The usual ones are
# the oldest that the toolkit knows, for its major number, and these.
EVERY_CARD = (70, 75, 80, 86, 90, 100, 110, 120)
USUAL_CARDS = (80, 90)
# On one core of an AMD EPYC; a kernel's file for the usual cards.
SECONDS_OF_A_FILE, SECONDS_OF_A_KERNEL = 6, 20
# The oldest PyTorch whose stable ABI has what the ops take, and the oldest Python that it supports.
STABLE_ABI_SINCE, STABLE_PYTHON = "2.11", "cp310"
COMMANDS_THAT_COMPILE = {"build", "build_ext", "bdist_wheel", "editable_wheel", "develop", "install"}


def read_sources():
    """Returns {group: [word, ...]} of sources.txt."""
    groups = defaultdict(list)
    for line in (ROOT / "sources.txt").read_text().splitlines():
        words = line.partition("#")[0].split()
        if words:
            groups[words[0]] += words[1:]
    return groups


def import_build_tools():
    """Returns torch and torch.utils.cpp_extension, or stops with what the user has to type."""
    try:
        import torch
    except ImportError as error:
        sys.exit(
            f"{PACKAGE} compiles against PyTorch, which this Python ({sys.executable}) cannot import: {error}\n"
            "Install it first, then build against it:\n"
            "    pip install torch setuptools wheel ninja\n"
            "    pip install --no-build-isolation ."
        )
    try:
        from torch.utils import cpp_extension
    except ImportError as error:
        if error.name != "pkg_resources":
            raise
        sys.exit(
            f"torch {torch.__version__} builds extensions with pkg_resources, which setuptools "
            f"{setuptools.__version__} no longer has. Take an older one, then build again:\n"
            "    pip install 'setuptools<82'\n"
            "    pip install --no-build-isolation ."
        )
    return torch, cpp_extension


def nvcc_of(cuda_home):
    """Returns the path of the toolkit's compiler, or None."""
    path = os.path.join(cuda_home or "", "bin", "nvcc")
    return path if cuda_home and os.path.isfile(path) else None


def answer(*command):
    return subprocess.run(command, stdout=subprocess.PIPE, check=True, universal_newlines=True).stdout


def reasons_against_cuda(cuda_sources, torch, cuda_home):
    """Returns why the CUDA backend is not built, as a list; empty where it is."""
    wish = os.environ.get("DSMOE_BUILD_CUDA", "")
    if wish not in ("", "auto", "0", "1"):
        sys.exit(f"DSMOE_BUILD_CUDA is {wish!r}; it must be auto, 0 or 1")
    if wish == "0":
        return ["it was built with DSMOE_BUILD_CUDA=0"]
    reasons = []
    if not cuda_sources:
        reasons.append("this version has no CUDA backend")
    if torch.version.cuda is None:
        reasons.append(f"torch {torch.__version__} is a build without CUDA")
    nvcc = nvcc_of(cuda_home)
    if nvcc is None:
        reasons.append("no CUDA toolkit was found (nvcc; CUDA_HOME names its folder)")
    elif torch.version.cuda is not None:
        release = re.search(r"release ([0-9.]+)", answer(nvcc, "--version")).group(1)
        if release.split(".")[0] != torch.version.cuda.split(".")[0]:  # torch refuses to build with another one
            reasons.append(f"{nvcc} is of CUDA {release}, but torch {torch.__version__} of {torch.version.cuda}")
    if wish == "1" and reasons:
        sys.exit("DSMOE_BUILD_CUDA=1, but " + "; ".join(reasons))
    named = os.environ.get("TORCH_CUDA_ARCH_LIST") or os.environ.get("DSMOE_CUDA_ARCH")
    if not reasons and not wish and not named and torch.cuda.device_count() == 0:
        reasons.append("no GPU was seen during the build; DSMOE_BUILD_CUDA=1 compiles for a GPU anyway")
    return reasons


def announcement(sources, without_cuda):
    """What is compiled, and about how long that takes at most: where some of it has been compiled before, less."""
    jobs = int(os.environ.get("MAX_JOBS") or os.cpu_count() or 1)
    seconds = sum(SECONDS_OF_A_KERNEL if path.endswith(".cu") else SECONDS_OF_A_FILE for path in sources) / jobs
    why = "; ".join(without_cuda)
    target = "for the CPU" if why else "for CPU and GPU"
    return (f"{PACKAGE}: compiling {len(sources)} files, {jobs} at once, {target}: "
            f"about {max(1, round(seconds / 60))} min" + (f" (without CUDA: {why})" if why else ""))


def tell(text):
    """Prints a line, and shows it on the terminal where pip keeps what a build prints."""
    print(text, flush=True)
    if not sys.stdout.isatty():
        try:
            with open("/dev/tty", "w") as terminal:
                terminal.write(f"\n  {text}\n")
        except OSError:  # there is none
            pass


def architecture_flags(nvcc, torch):
    """Returns nvcc's flags where no card is seen, as torch has no default there: DSMOE_CUDA_ARCH=usual or all, and PTX.

    Empty where TORCH_CUDA_ARCH_LIST says for which cards, or where torch sees some: it compiles for those.
    """
    if os.environ.get("TORCH_CUDA_ARCH_LIST") or torch.cuda.device_count() > 0:
        return []
    wish = os.environ.get("DSMOE_CUDA_ARCH", "usual")
    if wish not in ("usual", "all"):
        sys.exit(f"DSMOE_CUDA_ARCH is {wish!r}; it must be usual or all (TORCH_CUDA_ARCH_LIST takes any list)")
    known = answer(nvcc, "--list-gpu-arch").split()
    chosen = [number for number in EVERY_CARD if f"compute_{number}" in known]
    if wish == "usual":
        chosen = chosen[:1] + [number for number in chosen[1:] if number in USUAL_CARDS]
    print(f"No GPU is seen: the kernels are compiled for compute capability "
          f"{', '.join(str(number / 10) for number in chosen)}, and as PTX for later cards, which compile it when they "
          "first run it. DSMOE_CUDA_ARCH=all compiles for every card, TORCH_CUDA_ARCH_LIST for those that it names.")
    kinds = [(number, f"sm_{number}") for number in chosen] + [(chosen[-1], f"compute_{chosen[-1]}")]
    return [f"-gencode=arch=compute_{number},code={kind}" for number, kind in kinds]


def compiled_libraries(torch):
    """Returns the libraries that CMake has built, by the group of sources.txt that each holds, in the order of linking.

    Empty where all is compiled here. Torch releases of the older C++ ABI cannot link them.
    """
    folder = os.environ.get("DSMOE_CORE_FOLDER")
    if not folder or not torch.compiled_with_cxx11_abi():
        return {}
    paths = {group: Path(folder) / f"libdsmoe_{group}.a" for group in ("cuda", "core", "io")}
    return {group: str(path) for group, path in paths.items() if path.is_file()}


def extension():
    """Returns the arguments of setup() that build libdsmoe.so and `diff_smoe_rasterization._C`."""
    torch, cpp_extension = import_build_tools()
    sources = read_sources()
    without_cuda = reasons_against_cuda(sources["cuda"], torch, cpp_extension.CUDA_HOME)
    stable = os.environ.get("DSMOE_STABLE_ABI", "0") == "1"
    ops = ["torch", "stable_abi" if stable else "torch_cpp"] + ([] if without_cuda else ["torch_cuda"])
    groups = ["core", "io"] + ([] if without_cuda else ["cuda"]) + ([] if stable else ops)
    libraries = {group: path for group, path in compiled_libraries(torch).items() if group in groups}
    if stable:
        libraries.pop("io", None)  # torch builds no library of no source
    flags = sources["flags"] + ["-g0", "-pthread"]
    if tuple(int(number) for number in torch.__version__.split(".")[:2]) < (2, 0):
        flags.append("-std=c++17")  # torch's own default there is C++14; later ones bring what they need
    nvcc_flags = ["-O3"]
    if not without_cuda:
        nvcc_flags += architecture_flags(nvcc_of(cpp_extension.CUDA_HOME), torch)
    folders = [str(ROOT / PACKAGE / folder) for folder in ("include", "csrc")]
    make = cpp_extension.CppExtension if without_cuda else cpp_extension.CUDAExtension
    library = make(
        f"{PACKAGE}.{LIBRARY}",
        [f"{PACKAGE}/{path}" for group in groups if group not in libraries for path in sources[group]],
        include_dirs=folders,
        # C++ programs that link the library call what it exports; calls inside need not go through the table for that.
        extra_compile_args={"cxx": flags + ["-fno-semantic-interposition"], "nvcc": nvcc_flags},
        extra_link_args=["-pthread", f"-Wl,-soname,{LIBRARY}.so", *(f"-Wl,-rpath,{path}" for path in LIBRARY_PATHS),
                         "-Wl,--whole-archive", *libraries.values(), "-Wl,--no-whole-archive"],
    )
    library.libraries.remove("torch_python")
    macros = [] if without_cuda else [("DSMOE_WITH_CUDA", None)]
    if stable:
        major, minor = map(int, STABLE_ABI_SINCE.split("."))
        macros += [("DSMOE_STABLE_ABI", None), ("TORCH_TARGET_VERSION", f"0x{major:02x}{minor:02x}000000000000")]
        # With its own CUDA runtime it needs none of PyTorch's libraries.
        library.libraries = [] if without_cuda else ["cudart_static", "dl", "rt"]
        macros += [] if without_cuda else [("USE_CUDA", None)]  # by which PyTorch declares its functions of CUDA
    module = (make if stable else cpp_extension.CppExtension)(
        f"{PACKAGE}._C",
        [f"{PACKAGE}/{path}" for group in ["python"] + (ops if stable else []) for path in sources[group]],
        include_dirs=folders,
        define_macros=macros,
        extra_compile_args={"cxx": flags + ["-fvisibility=hidden"]},
        extra_link_args=["-Wl,-rpath,$ORIGIN"],
        py_limited_api=stable,
    )
    if stable:
        module.libraries = ["torch_cpu"]
    built_against = {
        "TORCH_VERSION": torch.__version__,
        "CUDA_VERSION": None if without_cuda else torch.version.cuda,
        "WITHOUT_CUDA_BECAUSE": "; ".join(without_cuda),
        "CXX11_ABI": torch.compiled_with_cxx11_abi(),
        "STABLE_ABI_SINCE": STABLE_ABI_SINCE if stable else None,
        "COMMIT": commit(),
    }

    class BuildExtension(cpp_extension.BuildExtension):
        def run(self):
            tell(announcement(library.sources + module.sources, without_cuda))
            self.parallel = None  # _C links the library: one after the other, also under `build_ext -j`
            module.extra_objects = [os.path.join(self.build_lib, self.get_ext_filename(library.name))]
            super().run()
            lines = ['"""What the extension was built against; readable even where it cannot be loaded."""']
            lines += [f"{name} = {value!r}" for name, value in built_against.items()]
            Path(self.get_ext_fullpath(module.name)).with_name("_build_info.py").write_text("\n".join(lines) + "\n")

        def get_ext_filename(self, name):
            if name.endswith(LIBRARY):  # no module: a name without the tag of a Python
                return os.path.join(*name.split(".")) + ".so"
            return super().get_ext_filename(name)

    tag = {"options": {"bdist_wheel": {"py_limited_api": STABLE_PYTHON}}} if stable else {}
    return {"ext_modules": [library, module], "cmdclass": {"build_ext": BuildExtension}, **tag}


def commit():
    """The commit of the source folder, "+" behind it where tracked files were changed; None where git does not say."""
    def git(*words):
        return subprocess.run(["git", "-C", str(ROOT), *words], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                              check=True).stdout.decode().strip()

    try:
        if not os.path.samefile(git("rev-parse", "--show-toplevel"), ROOT):
            return None
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


if __name__ == "__main__":
    if int(setuptools.__version__.split(".")[0]) < 61:  # it would ignore pyproject.toml and install "UNKNOWN 0.0.0"
        sys.exit(f"setuptools {setuptools.__version__} is too old; type: pip install 'setuptools>=61,<82'; build again")
    setuptools.setup(**(extension() if COMMANDS_THAT_COMPILE & set(sys.argv) else {}))
