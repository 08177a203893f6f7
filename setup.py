"""Builds libdsmoe.so, the torch ops and the extension _core by CMake: csrc/python/CMakeLists.txt.

Metadata: pyproject.toml. Environment: DSMOE_BUILD_CUDA=auto|0|1 (auto: if torch and the machine have CUDA; unset:
if also a GPU is seen, or cards are named), TORCH_CUDA_ARCH_LIST, MAX_JOBS; DSMOE_CUDA_ARCH=all compiles for every
card if none is seen; DSMOE_CORE_FOLDER=DIR links the libraries that CMake has built in DIR (libdsmoe_core.a,
libdsmoe_io.a, libdsmoe_cuda.a) in place of compiling their sources once more; DSMOE_STABLE_ABI=1 makes the ops by
LibTorch's stable ABI: they load with every PyTorch from 2.11 on; then DSMOE_PYTHONS="python3.10 python3.12" builds
_core for these Pythons too, and a wheel is for all of them.
"""
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import setuptools
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent
PACKAGE = "diff_smoe_rasterization"
# What is compiled for if no card is seen. A kernel runs on later cards of the same major number too; cards after the
# last compile its PTX when they first run it. EVERY_CARD: what torch's own builds are for, and 11.0. The usual ones are
# the oldest that the toolkit knows, for its major number, and these.
EVERY_CARD = (70, 75, 80, 86, 90, 100, 110, 120)
USUAL_CARDS = (80, 90)
# What compiling takes on one core of an AMD EPYC, by file: build_support/seconds_to_compile FOLDER wrote it. Files that
# are not in it, and kernels, for the usual cards:
SECONDS_TO_COMPILE = ROOT / "build_support" / "seconds_to_compile.txt"
SECONDS_OF_A_FILE, SECONDS_OF_A_KERNEL = 6, 20
# The oldest PyTorch whose stable ABI has what the ops take, and as its headers write it.
STABLE_ABI_SINCE, TORCH_TARGET_VERSION = "2.11", "0x020b000000000000"
# The folders at the top that are parts of packages, by the link that puts each there.
LINKS = {"diff_smoe_rasterization/integrations": "../integrations", "dsmoe/bench": "../benchmarks/harness",
         "dsmoe/patches": "../patches"}
COMMANDS_THAT_COMPILE = {"build", "build_ext", "bdist_wheel", "editable_wheel", "develop", "install"}


def restore_links(root):
    """Makes the links anew: pip and Python's zipfile unpack those of a .zip as text, and an sdist holds none."""
    for link, target in LINKS.items():
        path = Path(root, link)
        if path.is_file():
            path.unlink()
        if not path.exists():
            path.symlink_to(target, target_is_directory=True)


def import_build_tools():
    """Returns torch and torch.utils.cpp_extension, or stops with what the user has to type."""
    try:
        import torch
    except ImportError as error:
        sys.exit(
            f"{PACKAGE} compiles against PyTorch, which this Python ({sys.executable}) cannot import: {error}\n"
            "Install it first, then build against it:\n"
            "    pip install torch setuptools wheel cmake ninja\n"
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


def reasons_against_cuda(torch, cuda_home):
    """Returns why the CUDA backend is not built, as a list; empty if it is."""
    wish = os.environ.get("DSMOE_BUILD_CUDA", "")
    if wish not in ("", "auto", "0", "1"):
        sys.exit(f"DSMOE_BUILD_CUDA is {wish!r}; it must be auto, 0 or 1")
    if wish == "0":
        return ["it was built with DSMOE_BUILD_CUDA=0"]
    reasons = []
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


def jobs():
    return int(os.environ.get("MAX_JOBS") or os.cpu_count() or 1)


def seconds_of(sources):
    """Returns about how long each file compiles on one core."""
    measured = dict(reversed(line.split()) for line in SECONDS_TO_COMPILE.read_text().splitlines())
    return [float(measured.get(Path(path).name, SECONDS_OF_A_KERNEL if path.endswith(".cu") else SECONDS_OF_A_FILE))
            for path in sources]


def announcement(sources, without_cuda):
    """What is compiled, and about how long that takes at most: if some of it has been compiled before, less."""
    seconds = sum(seconds_of(sources)) / jobs()
    why = "; ".join(without_cuda)
    target = "for the CPU" if why else "for CPU and GPU"
    return (f"{PACKAGE}: compiling {len(sources)} files, {jobs()} at once, {target}: "
            f"about {max(1, round(seconds / 60))} min" + (f" (without CUDA: {why})" if why else ""))


def tell(text):
    """Prints a line, and shows it on the terminal if pip keeps what a build prints."""
    print(text, flush=True)
    if not sys.stdout.isatty():
        try:
            with open("/dev/tty", "w") as terminal:
                terminal.write(f"\n  {text}\n")
        except OSError:  # there is none
            pass


def architecture_flags(nvcc, torch):
    """Returns nvcc's flags if no card is seen, as torch has no default there: DSMOE_CUDA_ARCH=usual or all, and PTX.

    Empty if TORCH_CUDA_ARCH_LIST says for which cards, or if torch sees some: it compiles for those.
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


def pybind11_folder(torch):
    """Returns the folder of pybind11's headers: those of the package, or if it is not installed PyTorch's copy."""
    try:
        import pybind11
    except ImportError:
        return os.path.join(os.path.dirname(torch.__file__), "include")
    return pybind11.get_include()


def pythons(stable):
    """Returns the Pythons that _core is built for, as {suffix of extensions: folder of headers}."""
    ask = "import sysconfig; print(sysconfig.get_config_var('EXT_SUFFIX'), sysconfig.get_path('include'), sep='\\n')"
    asked = os.environ.get("DSMOE_PYTHONS", "").split() if stable else []
    return dict(answer(python, "-c", ask).splitlines() for python in [sys.executable, *asked])


def options_of_cmake(torch, cpp_extension, with_cuda, stable):
    """Returns what CMakeLists.txt asks: this Python, this PyTorch, and for which cards, as {name: value}."""
    release = tuple(int(number) for number in torch.__version__.split(".")[:2])
    core = os.environ.get("DSMOE_CORE_FOLDER") if torch.compiled_with_cxx11_abi() else None  # it has the newer ABI
    includes = cpp_extension.include_paths() + [sysconfig.get_path(name) for name in ("include", "platinclude")]
    options = {
        "DSMOE_PYTHON_PACKAGE": "ON",
        "DSMOE_BUILD_TESTS": "OFF",
        "DSMOE_BUILD_TOOLS": "OFF",
        "DSMOE_CUDA": "ON" if with_cuda else "OFF",
        "DSMOE_STABLE_ABI": TORCH_TARGET_VERSION if stable else "OFF",
        "DSMOE_CXX11_ABI": int(torch.compiled_with_cxx11_abi()),
        "DSMOE_CXX_STANDARD": 17 if release < (2, 13) else 20,
        "DSMOE_INCLUDES": ";".join(includes),
        "DSMOE_PYBIND11": pybind11_folder(torch),
        "DSMOE_PYTHONS": ";".join("=".join(one) for one in pythons(stable).items()),
        "DSMOE_LIBRARY_FOLDERS": ";".join(cpp_extension.library_paths()),
        "DSMOE_CORE_FOLDER": os.path.abspath(core) if core else "",
    }
    if with_cuda:
        nvcc = nvcc_of(cpp_extension.CUDA_HOME)
        options["CMAKE_CUDA_COMPILER"] = nvcc
        options["CMAKE_CUDA_FLAGS"] = " ".join(architecture_flags(nvcc, torch) or cpp_extension._get_cuda_arch_flags())
        options["CMAKE_CUDA_ARCHITECTURES"] = "OFF"  # the flags have them
        if os.environ.get("CC"):
            options["CMAKE_CUDA_HOST_COMPILER"] = os.environ["CC"]
    return options


def find_program(name):
    """Returns the path of a program, or None. That of this Python's environment need not be active."""
    return shutil.which(name) or shutil.which(name, path=os.path.dirname(sys.executable))


def run_cmake(*words):
    cmake = find_program("cmake")
    if cmake is None:
        sys.exit(f"{PACKAGE} is built by CMake (3.21 or later), which is not installed; type: pip install cmake")
    if subprocess.run([cmake, *map(str, words)]).returncode != 0:
        sys.exit(f"CMake could not build {PACKAGE}; the lines above say why")


def configure(folder, options):
    """Configures a build in `folder`, where an earlier one has left its objects; returns the files that it compiles."""
    ninja = find_program("ninja")
    generator = ["-G", "Ninja", f"-DCMAKE_MAKE_PROGRAM={ninja}"] if ninja else ["-G", "Unix Makefiles"]
    if (folder / "CMakeCache.txt").exists():
        (folder / "CMakeCache.txt").unlink()  # may name programs of an environment that pip has removed
    run_cmake("-S", ROOT, "-B", folder, *generator, "-DCMAKE_EXPORT_COMPILE_COMMANDS=ON",
              *(f"-D{name}={value}" for name, value in options.items()))
    return [entry["file"] for entry in json.loads((folder / "compile_commands.json").read_text())]


def replace(source, target):
    """Copies a library. Processes that have loaded the old one keep it: its file is not written into."""
    fresh = target.with_name(target.name + ".new")
    shutil.copy2(source, fresh)
    os.replace(fresh, target)


def extension():
    """Returns the arguments of setup() that build libdsmoe.so, _ops.so and `diff_smoe_rasterization._core`."""
    torch, cpp_extension = import_build_tools()
    without_cuda = reasons_against_cuda(torch, cpp_extension.CUDA_HOME)
    stable = os.environ.get("DSMOE_STABLE_ABI", "0") == "1"
    module = setuptools.Extension(f"{PACKAGE}._core", [])
    built_against = {
        "TORCH_VERSION": torch.__version__,
        "CUDA_VERSION": None if without_cuda else torch.version.cuda,
        "WITHOUT_CUDA_BECAUSE": "; ".join(without_cuda),
        "CXX11_ABI": torch.compiled_with_cxx11_abi(),
        "STABLE_ABI_SINCE": STABLE_ABI_SINCE if stable else None,
        "COMMIT": commit(),
    }

    class BuildExtension(build_ext):
        def run(self):
            # Not in build_temp, which an editable install removes.
            name = f"cmake-{'stable-abi' if stable else sys.implementation.cache_tag}"
            folder = Path(self.get_finalized_command("build").build_base).resolve() / name
            files = configure(folder, options_of_cmake(torch, cpp_extension, not without_cuda, stable))
            tell(announcement(files, without_cuda))
            for file, seconds in zip(files, seconds_of(files)):
                print(f"cost {seconds:g} {Path(file).name}")  # by which build_support/environment.sh says what is left
            sys.stdout.flush()
            run_cmake("--build", folder, "--parallel", jobs(), "--target", "dsmoe_package")
            path = Path(self.get_ext_fullpath(module.name))
            path.parent.mkdir(parents=True, exist_ok=True)
            names = ["libdsmoe.so", "_ops.so", *(f"_core{suffix}" for suffix in pythons(stable))]
            for left in path.parent.glob("_core*.so"):  # of another Python, over an earlier libdsmoe.so
                if left.name not in names:
                    left.unlink()
            for name in names:
                replace(folder / "package" / name, path.with_name(name))
            lines = ['"""What the extension was built against; readable even where it cannot be loaded."""']
            lines += [f"{name} = {value!r}" for name, value in built_against.items()]
            path.with_name("_build_info.py").write_text("\n".join(lines) + "\n")

    return {"ext_modules": [module], "cmdclass": {"build_ext": BuildExtension, **(any_python() if stable else {})}}


def any_python():
    """Returns the command that names a wheel by the Pythons that it has a _core for, such as cp310.cp312-none."""
    try:
        from setuptools.command.bdist_wheel import bdist_wheel
    except ImportError:  # setuptools before 70.1
        from wheel.bdist_wheel import bdist_wheel

    class AnyPython(bdist_wheel):
        def get_tag(self):
            releases = sorted(re.search(r"cpython-(\d+)", suffix)[1] for suffix in pythons(stable=True))
            return (".".join("cp" + release for release in releases), "none", super().get_tag()[2])

    return {"bdist_wheel": AnyPython}


def commit():
    """The commit of the source folder, "+" behind it if tracked files were changed; None if git does not say."""
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
    restore_links(ROOT)
    setuptools.setup(**(extension() if COMMANDS_THAT_COMPILE & set(sys.argv) else {}))
