"""What the build reads and what it installs."""
from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import inspect
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from packaged import packages_and_data

import diff_smoe_rasterization
from diff_smoe_rasterization import extension, reference
from dsmoe.options import quickstart_options

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "diff_smoe_rasterization"
INSTALLED = Path(diff_smoe_rasterization.__file__).parent


def test_the_package_brings_every_public_header():
    names = {path.name for path in (SOURCE / "include" / "dsmoe").iterdir()}
    assert "rasterize.h" in names
    assert names == {path.name for path in (INSTALLED / "include" / "dsmoe").iterdir()}


def test_type_checkers_find_the_types_of_public_functions():
    assert (INSTALLED / "py.typed").is_file() and "py.typed" in packages_and_data()[1][SOURCE.name]
    functions = [diff_smoe_rasterization.GaussianRasterizer.forward, reference.rasterize, reference.contributions,
                 reference.importance,
                 *(getattr(diff_smoe_rasterization, name) for name in diff_smoe_rasterization.__all__)]
    for function in filter(inspect.isfunction, functions):
        unknown = set(inspect.signature(function).parameters) - set(function.__annotations__) - {"self"}
        assert not unknown and "return" in function.__annotations__, (function, unknown)


def test_the_build_wrote_down_its_torch():
    info = pytest.importorskip("diff_smoe_rasterization._build_info", reason="not built by setup.py")
    assert info.STABLE_ABI_SINCE or info.TORCH_VERSION == torch.__version__
    assert info.WITHOUT_CUDA_BECAUSE or "cuda" in extension.BACKENDS
    assert info.COMMIT is None or re.fullmatch("[0-9a-f]{40}[+]?", info.COMMIT)


def load_setup():
    """setup.py as a module; it builds nothing unless it is run."""
    pytest.importorskip("setuptools")
    spec = importlib.util.spec_from_file_location("dsmoe_setup", ROOT / "setup.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("as_text", [True, False])
def test_links_of_the_tree_are_made_again(tmp_path, as_text):
    """A .zip leaves them as text, an sdist leaves them out."""
    setup = load_setup()
    links = [path for package in ("diff_smoe_rasterization", "dsmoe") for path in (ROOT / package).iterdir()
             if path.is_symlink()]
    assert {path.relative_to(ROOT).as_posix(): os.readlink(path) for path in links} == setup.LINKS
    for link, target in setup.LINKS.items():
        path = tmp_path / link
        path.parent.mkdir(exist_ok=True)
        if as_text:
            path.write_text(target)
        (path.parent / target).mkdir(parents=True, exist_ok=True)
    for _ in range(2):
        setup.restore_links(tmp_path)
        for link, target in setup.LINKS.items():
            assert (tmp_path / link).samefile((tmp_path / link).parent / target)


def test_an_sdist_holds_each_file_of_the_linked_folders_once(tmp_path):
    pytest.importorskip("setuptools")
    subprocess.run([sys.executable, "setup.py", "-q", "egg_info", "--egg-base", str(tmp_path)], cwd=str(ROOT),
                   check=True, stderr=subprocess.PIPE)
    names = next(tmp_path.glob("*.egg-info/SOURCES.txt")).read_text().splitlines()
    for folder, link in (("integrations", "integrations"), ("patches", "patches"), ("benchmarks/harness", "bench")):
        held = [name for name in names if (name.startswith(folder + "/") or f"/{link}/" in name)
                and not name.startswith("tests/") and name.endswith((".py", ".md"))]
        there = [path for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".md")]
        assert f"{folder}/__init__.py" in held
        assert sorted(held) == sorted(path.relative_to(ROOT).as_posix() for path in there)


def test_a_build_does_not_write_into_a_loaded_library(tmp_path):
    source, target = tmp_path / "built.so", tmp_path / "libdsmoe.so"
    source.write_text("new")
    target.write_text("old")
    with open(target) as loaded:
        load_setup().replace(source, target)
        assert (loaded.read(), target.read_text()) == ("old", "new")


def files_of(compiled):
    """The files that CMake compiles as one, or the file itself."""
    path = Path(compiled)
    return re.findall('^#include "(.*)"$', path.read_text(), re.MULTILINE) if path.suffix == ".cxx" else [compiled]


@pytest.mark.skipif(not (shutil.which("cmake") and shutil.which("c++")), reason="needs cmake and c++")
def test_every_file_is_compiled_once(tmp_path, monkeypatch):
    """Configured only. What is for CUDA needs a toolkit, and is left out here."""
    monkeypatch.delenv("DSMOE_CORE_FOLDER", raising=False)
    setup = load_setup()
    compiled = {}
    for stable in (False, True):
        options = setup.options_of_cmake(*setup.import_build_tools(), with_cuda=False, stable=stable)
        files = setup.configure(tmp_path / str(stable), options)
        compiled[stable] = [path for file in files for path in files_of(file) if SOURCE in Path(path).parents]
        assert len(compiled[stable]) == len({*compiled[stable]})
    files = {str(path) for path in SOURCE.rglob("*.cpp")}
    for_cuda = {path for path in files if "/cuda/" in path or path.endswith("_cuda.cpp")}
    assert for_cuda and {*compiled[False], *compiled[True]} == files - for_cuda
    assert {Path(path).name for path in {*compiled[True]} - {*compiled[False]}} == {"tensor_stable.cpp"}


def test_the_build_knows_its_commit(tmp_path, monkeypatch):
    setup = load_setup()
    monkeypatch.setattr(setup, "ROOT", tmp_path)
    assert setup.commit() is None
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    file = tmp_path / "file"
    file.write_text("1")
    try:
        for words in (["init", "-q"], ["add", "file"], ["commit", "-q", "-m", "first"]):
            subprocess.run(git + words, check=True)
    except OSError:
        pytest.skip("git is not installed")
    commit = setup.commit()
    assert re.fullmatch("[0-9a-f]{40}", commit)
    file.write_text("2")
    assert setup.commit() == commit + "+"
    (tmp_path / "inside").mkdir()
    monkeypatch.setattr(setup, "ROOT", tmp_path / "inside")
    assert setup.commit() is None


def toolkit(folder, release, *architectures):
    """Makes the folder of a CUDA toolkit, whose nvcc only answers questions; returns (folder, nvcc)."""
    nvcc = folder / "bin" / "nvcc"
    nvcc.parent.mkdir()
    nvcc.write_text(f"""#!/bin/sh
case "$*" in
  --version) echo 'Cuda compilation tools, release {release}, V{release}.48' ;;
  --list-gpu-arch) printf 'compute_%s\\n' {" ".join(map(str, architectures))} ;;
  *) exit 1 ;;
esac
""")
    nvcc.chmod(0o755)
    return str(folder), str(nvcc)


def torch_of(cuda=None, cards=0):
    """What setup.py asks torch for: the CUDA release that it was built with, and how many cards it sees."""
    return SimpleNamespace(__version__="2.0", version=SimpleNamespace(cuda=cuda),
                           cuda=SimpleNamespace(device_count=lambda: cards))


def runs_on(capability, flags):
    """Whether a card has a kernel: a binary of its major number and no later minor one, or PTX that is no later."""
    binaries = [int(flag.rpartition("code=sm_")[2]) for flag in flags if "code=sm_" in flag]
    intermediate = [int(flag.rpartition("code=compute_")[2]) for flag in flags if "code=compute_" in flag]
    return (any(number // 10 == capability // 10 and number <= capability for number in binaries)
            or any(number <= capability for number in intermediate))


@pytest.mark.parametrize("wish", ["usual", "all"])
@pytest.mark.parametrize("release, known, oldest", [
    ("11.4", (35, 50, 52, 60, 61, 62, 70, 72, 75, 80, 86, 87), 70),
    ("12.0", (50, 52, 60, 61, 70, 72, 75, 80, 86, 87, 89, 90), 70),
    ("13.0", (75, 80, 86, 87, 88, 89, 90, 100, 110, 103, 120, 121), 75),
])
def test_without_a_card_kernels_are_built_for_all(tmp_path, monkeypatch, capsys, release, known, oldest, wish):
    """Those that the toolkit knows from 7.0 on, and those that come later; by default with fewer binaries, and PTX."""
    monkeypatch.delenv("TORCH_CUDA_ARCH_LIST", raising=False)
    monkeypatch.setenv("DSMOE_CUDA_ARCH", wish)
    flags = load_setup().architecture_flags(toolkit(tmp_path, release, *known)[1], torch_of(release))
    assert f"compute capability {oldest / 10}, " in capsys.readouterr().out
    assert wish == "all" or len(flags) <= 4
    assert all(flag.startswith("-gencode=arch=compute_") for flag in flags)
    built = [int(flag.rpartition("_")[2]) for flag in flags]
    assert set(built) <= set(known) and min(built) == oldest
    for capability in [number for number in known if number >= 70] + [129, 130]:
        assert runs_on(capability, flags), capability


def test_cmake_is_told_what_torch_and_the_environment_say(tmp_path, monkeypatch):
    folder, nvcc = toolkit(tmp_path, "12.8", 80, 90)
    setup = load_setup()
    tools = SimpleNamespace(**{**vars(setup.import_build_tools()[1]), "CUDA_HOME": folder})

    def options(release, cxx11_abi, with_cuda=True):
        fake = SimpleNamespace(**{**vars(torch_of("12.8")), "__version__": release, "__file__": torch.__file__,
                                  "compiled_with_cxx11_abi": lambda: cxx11_abi})
        return setup.options_of_cmake(fake, tools, with_cuda=with_cuda, stable=False)

    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("DSMOE_CORE_FOLDER", str(tmp_path))
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "8.6")
    told = options("2.13.0+cu128", True)
    assert (told["DSMOE_CXX_STANDARD"], told["DSMOE_CORE_FOLDER"]) == (20, str(tmp_path))
    assert told["CMAKE_CUDA_COMPILER"] == nvcc and "CMAKE_CUDA_HOST_COMPILER" not in told
    assert told["CMAKE_CUDA_FLAGS"] == "-gencode=arch=compute_86,code=sm_86"
    monkeypatch.setenv("CC", "gcc-12")
    monkeypatch.delenv("TORCH_CUDA_ARCH_LIST")
    monkeypatch.setenv("DSMOE_CUDA_ARCH", "usual")
    told = options("1.13.0a0", False)
    assert (told["DSMOE_CXX_STANDARD"], told["DSMOE_CORE_FOLDER"], told["DSMOE_CXX11_ABI"]) == (17, "", 0)
    assert told["CMAKE_CUDA_HOST_COMPILER"] == "gcc-12" and "code=compute_90" in told["CMAKE_CUDA_FLAGS"]
    assert not [name for name in options("2.4.1", False, with_cuda=False) if "CMAKE_CUDA" in name]


@pytest.mark.parametrize("torch_cuda, built", [("12.8", True), ("12.1", True), ("11.8", False), (None, False)])
def test_cuda_is_built_where_torch_and_the_toolkit_fit(tmp_path, monkeypatch, torch_cuda, built):
    monkeypatch.setenv("DSMOE_BUILD_CUDA", "auto")
    setup, (folder, _) = load_setup(), toolkit(tmp_path, "12.8", 80)
    reasons = setup.reasons_against_cuda(torch_of(torch_cuda), folder)
    assert len(reasons) == (0 if built else 1)
    assert setup.reasons_against_cuda(torch_of(torch_cuda), str(tmp_path / "bin")) != []
    monkeypatch.setenv("DSMOE_BUILD_CUDA", "1")
    if built:
        assert setup.reasons_against_cuda(torch_of(torch_cuda), folder) == []
    else:
        with pytest.raises(SystemExit, match="DSMOE_BUILD_CUDA=1, but " + re.escape(reasons[0])):
            setup.reasons_against_cuda(torch_of(torch_cuda), folder)


def test_without_a_card_no_kernels_are_built_unless_asked(tmp_path, monkeypatch):
    """As ./quickstart decides."""
    asking = {"DSMOE_BUILD_CUDA": "auto", "TORCH_CUDA_ARCH_LIST": "8.6", "DSMOE_CUDA_ARCH": "all"}
    for name in asking:
        monkeypatch.delenv(name, raising=False)
    setup, (folder, _) = load_setup(), toolkit(tmp_path, "12.8", 80)
    assert setup.reasons_against_cuda(torch_of("12.8", cards=1), folder) == []
    reason, = setup.reasons_against_cuda(torch_of("12.8"), folder)
    assert "no GPU was seen" in reason and "DSMOE_BUILD_CUDA=1" in reason
    for name, value in asking.items():
        with monkeypatch.context() as patch:
            patch.setenv(name, value)
            assert setup.reasons_against_cuda(torch_of("12.8"), folder) == [], name


def test_the_build_says_how_long_it_takes(monkeypatch):
    monkeypatch.setenv("MAX_JOBS", "2")
    setup = load_setup()
    said = setup.announcement(["a.cpp"] * 40, ["no GPU was seen"])  # 40 files of 6 s on 2 cores
    assert "40 files, 2 at once, for the CPU: about 2 min (without CUDA: no GPU was seen)" in said
    assert "for CPU and GPU: about 5 min" in setup.announcement(["a.cpp"] * 40 + ["b.cu"] * 18, [])
    names = [line.split()[1] for line in setup.SECONDS_TO_COMPILE.read_text().splitlines()]
    there = {path.name for path in (SOURCE / "csrc").rglob("*.c*")}
    of_today = sum(setup.seconds_of([name for name in names if name in there or name.endswith(".cxx")]))  # groups
    assert of_today > 0.9 * sum(setup.seconds_of(names)), "measure again: build_support/seconds_to_compile"
    assert setup.seconds_of(["csrc/cpu/tile_kernels_avx2.cpp"]) > setup.seconds_of(["csrc/cpu/gather.cpp"])


def environment_sh(folder, commands):
    """What bash prints for these commands after build_support/environment.sh, with a Python that sees no GPU."""
    (folder / "bin").mkdir(exist_ok=True)
    if not (folder / "bin" / "python").exists():
        (folder / "bin" / "python").symlink_to("/bin/true")
    unset = {name: value for name, value in os.environ.items()
             if name not in ("DSMOE_BUILD_CUDA", "TORCH_CUDA_ARCH_LIST", "DSMOE_VENV")}
    program = f'set -eu; source "{ROOT}/build_support/environment.sh"; venv="{folder}" log="{folder}/log"\n{commands}'
    return subprocess.run(["bash", "-c", program], stdout=subprocess.PIPE, universal_newlines=True, env=unset,
                          check=True).stdout


def test_quickstart_builds_no_kernels_where_there_is_no_gpu_unless_asked(tmp_path):
    said = environment_sh(tmp_path, """
        pip_install() { echo "$DSMOE_BUILD_CUDA"; }
        install_package
        (export DSMOE_BUILD_CUDA=1; install_package)
        cuda_without_gpu=auto  # as ./check says
        install_package""")
    assert said.split() == ["0", "1", "auto"]


@pytest.mark.parametrize("words, status, error", [
    ("garden --iterations 10", 1, "error: scene garden: no such folder"),
    ("--iterations 10 -o out garden", 1, "error: scene garden: no such folder"),
    ("--iterations abc", 2, "argument --iterations: is 'abc'; it must be a whole number"),
    ("--iterations 0", 1, "error: --iterations is 0; it must be at least 1"),
    ("--iterations", 2, "argument --iterations: expected one argument"),
    ("--strategy none", 2, "argument --strategy"), ("--itertions 10", 2, "unrecognized arguments: --itertions"),
    ("--blend-mode smoe", 2, "unrecognized arguments: --blend-mode"), ("--budget 2", 1, "--budget is 2"),
    (f"-o {__file__}", 1, f"{__file__}: nothing can be written there: {__file__} is no folder"),
    (".", 1, "error: scene .: neither a folder `sparse` (COLMAP) nor"),
    ("--find-links=", 1, "error: --find-links needs a folder of wheels"),
    ("--find-links", 1, "error: --find-links needs a folder of wheels")])
def test_quickstart_knows_before_it_builds_what_is_wrong_with_its_options(tmp_path, words, status, error):
    run = subprocess.run([str(ROOT / "quickstart"), *words.split()], cwd=str(tmp_path),
                         env={**os.environ, "DSMOE_VENV": "venv"}, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                         universal_newlines=True)
    assert (run.returncode, run.stdout) == (status, "") and error in run.stderr and "Traceback" not in run.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", ["", "--budget 100", "--budget 100 --iterations 60 --device cpu"])
def test_options_of_quickstart_that_fit_are_taken(words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert quickstart_options.check(words.split()) == 0 and capsys.readouterr().err == ""


def test_a_long_step_says_how_many_files_are_compiled(tmp_path):
    said = environment_sh(tmp_path, """
        sleep() { command sleep 0.02; }  # in place of a minute
        compile() { echo "  [2/3] c++ -c a.cpp"; command sleep 0.5; }
        echo "[9/9] earlier" >"$log"
        step Compiling compile""")
    # Half a second may begin in one second and end in the next.
    assert re.search(r"2 of 3 files compiled \([01] s\)", said) and "9 of" not in said and "... done (" in said, said


@pytest.mark.parametrize("log, expected", [
    # 50 of 72 s are left after 22, of which 2 jobs do 82 in 50 s, with the half minute that is added.
    ("  cost 20 a.cpp\n  cost 2 b.cpp\n  cost 50 c.cpp\n  [1/4] Building CXX object x/torch/b.cpp.o\n"
     "  [2/4] Building CXX object x/a.cpp.o\n", "2 of 4 files compiled, 30 s left"),
    ("cost 400 c.cpp\n[0/2] Re-checking globbed directories...\n", "0 of 2 files compiled, 6 min left"),
    ("  Downloading https://a/b/torch-2.15.0.whl (539.1 MB)\n  Downloading x.whl.metadata (2 kB)\n",
     "torch-2.15.0.whl (539.1 MB)"), ("Collecting torch\n", "")])
def test_a_step_says_how_long_it_takes_by_what_files_cost(tmp_path, log, expected):
    (tmp_path / "log").write_text(log)
    assert environment_sh(tmp_path, 'progress 20 2 <"$log"').strip() == expected


def wheel_of(folder, version):
    """A wheel of that version without a file of the package."""
    name = f"diff_smoe_rasterization-{version}"
    with zipfile.ZipFile(folder / f"{name}-py3-none-any.whl", "w") as wheel:
        wheel.writestr(f"{name}.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{name}.dist-info/METADATA",
                       f"Metadata-Version: 2.1\nName: diff_smoe_rasterization\nVersion: {version}\n")
        wheel.writestr(f"{name}.dist-info/RECORD", "")


def test_quickstart_takes_a_wheel_that_is_named_and_else_compiles(tmp_path):
    python = tmp_path / "bin" / "python"
    python.parent.mkdir()
    python.write_text('#!/bin/sh\n'
                      'case "$*" in *"import diff_smoe"*) exit "$NOT_LOADED" ;; *"import"*torch*) exit 0 ;; esac\n'
                      f'exec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    (tmp_path / "bin" / "pip").symlink_to(python)
    wheels = tmp_path / "wheels"
    wheels.mkdir()

    def prepare(takes=wheels, loads=True):
        said = environment_sh(tmp_path, f"""
            takes_wheels="{takes}" environment=$venv
            export NOT_LOADED={int(not loads)}
            pip_install() {{ echo "$@" >>"$environment/installed"; }}
            install_package() {{ export NOT_LOADED=0; echo compiled >>"$environment/installed"; }}
            check_compiler() {{ :; }}
            prepare_environment "$environment" torch""")
        installed = tmp_path / "installed"
        lines = installed.read_text().splitlines() if installed.exists() else []
        installed.write_text("")
        return said, lines

    said, lines = prepare()
    assert "No wheel in" in said and lines[-1] == "compiled"
    for version in ("0.0.1", f"{diff_smoe_rasterization.__version__}+cpu"):
        wheel_of(wheels, version)
    (tmp_path / "dsmoe.stamp").unlink()
    said, lines = prepare()
    wheel = f"diff_smoe_rasterization-{diff_smoe_rasterization.__version__}+cpu-py3-none-any.whl"
    assert "Installing " + wheel in said and lines[0] == "--no-compile torch", "no build tools"
    assert wheel in lines[1] and wheel in lines[2] and len(lines) == 3
    assert "nothing has changed" in prepare()[0]
    assert prepare(takes="")[1][-1] == "compiled", "./check tests what the source says"
    assert "nothing has changed" in prepare(takes="")[0]
    (tmp_path / "dsmoe.stamp").unlink()
    said, lines = prepare(loads=False)
    assert "does not load with this PyTorch" in said and "ninja" in lines[-2] and lines[-1] == "compiled"


def test_a_card_or_a_list_decides_for_which_cards_kernels_are_built(tmp_path, monkeypatch):
    """Without such a flag torch builds for the cards that it sees, or for the list."""
    setup, (_, nvcc) = load_setup(), toolkit(tmp_path, "12.0", 80, 90)
    monkeypatch.delenv("TORCH_CUDA_ARCH_LIST", raising=False)
    assert setup.architecture_flags(nvcc, torch_of("12.0", cards=1)) == []
    monkeypatch.setenv("DSMOE_CUDA_ARCH", "some")
    with pytest.raises(SystemExit, match="DSMOE_CUDA_ARCH is 'some'"):
        setup.architecture_flags(nvcc, torch_of("12.0"))
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "8.6")
    assert setup.architecture_flags(nvcc, torch_of("12.0")) == []


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


@pytest.mark.parametrize("words", [["--version"], ["--help"], ["train", "--help"], ["completion", "bash"]])
def test_the_command_answers_without_loading_torch(tmp_path, words):
    (tmp_path / "dsmoe").write_text(f"""import atexit, sys
sys.path.insert(0, {str(INSTALLED.parent)!r})
atexit.register(lambda: print("numpy" in sys.modules or "torch" in sys.modules, file=sys.stderr))
from dsmoe.cli import main
sys.exit(main(sys.argv[1:]))""")
    run = subprocess.run([sys.executable, str(tmp_path / "dsmoe"), *words], stdout=subprocess.PIPE,
                         stderr=subprocess.PIPE, universal_newlines=True)
    assert (run.returncode, run.stderr) == (0, "False\n")
    if words[0] == "--version":
        assert run.stdout == f"dsmoe {diff_smoe_rasterization.__version__}\n"
    if words[0] == "completion":
        program = run.stdout + "COMP_WORDS=(dsmoe patch apply --mo) COMP_CWORD=3; _dsmoe; echo ${COMPREPLY[*]}"
        assert subprocess.run(["bash", "-c", program], stdout=subprocess.PIPE).stdout == b"--modernise\n"


def test_the_rasterizer_loads_torch_and_numpy_only():
    """All of its modules are imported, in a new Python. What torch itself loads does not count."""
    files = {*INSTALLED.rglob("*.py"), *(INSTALLED / "integrations").rglob("*.py")}  # rglob enters no link
    names = [".".join(path.relative_to(INSTALLED.parent).with_suffix("").parts) for path in files]
    assert {"diff_smoe_rasterization.io", "diff_smoe_rasterization.integrations.inria"} <= {*names}
    program = f"""import importlib, sys
import torch
before = {{*sys.modules}} - {{"torch", "numpy"}}
sys.path.insert(0, {str(INSTALLED.parent)!r})
for name in {sorted(names)!r}:
    importlib.import_module(name)
print(*sorted({{"torch", "numpy", "scipy", "PIL", "tqdm", "dsmoe"}} & {{*sys.modules}} - before))"""
    said = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, check=True, cwd=os.sep,
                          universal_newlines=True).stdout
    assert said.split() == ["numpy", "torch"]


@pytest.mark.skipif(not hasattr(sys, "stdlib_module_names"), reason="Python before 3.10 does not list its own modules")
def test_no_module_of_the_rasterizer_names_another_package():
    """Not the trainer either, and not inside a function."""
    imported = set()
    for path in [*SOURCE.rglob("*.py"), *(ROOT / "integrations").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                imported.add(node.module.partition(".")[0])
    assert imported - sys.stdlib_module_names == {"torch", "numpy", "diff_smoe_rasterization"}


def test_an_environment_that_is_too_old_is_told_before_anything_is_fetched():
    spec = importlib.util.spec_from_file_location("backend", ROOT / "build_support" / "backend.py")
    backend = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(backend)
    for python, release in (((3, 8), "1.13.0a0"), ((3, 12), "2.11.0+cu130"), ((3, 11), None)):
        backend.refuse_too_old(python, release)
    for python, release, reason in (((3, 7), None, "this is Python 3.7"), ((3, 8), "1.12.1+cu116", "PyTorch 1.12.1")):
        with pytest.raises(SystemExit, match=f"Python 3.8 and PyTorch 1.13.*{re.escape(reason)}.*docs/trainers.md"):
            backend.refuse_too_old(python, release)
