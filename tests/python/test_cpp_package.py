"""C++ programs that use the installed Python package through CMake: consumers, the documentation's, a trainer."""
from __future__ import annotations

import inspect
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import diff_smoe_rasterization
from diff_smoe_rasterization import extension
from diff_smoe_rasterization import settings as settings_module
from dsmoe.cli import main
from dsmoe.scenes.synthetic import write_synthetic_scene

ROOT = Path(__file__).resolve().parents[2]
INSTALLED = Path(diff_smoe_rasterization.__file__).parent
CONSUMER = ROOT / "tests" / "cpp" / "consumer"

needs_cmake = pytest.mark.skipif(not (shutil.which("cmake") and shutil.which("c++")), reason="needs cmake and c++")


def run(*words, **options):
    """What a command prints; its output is the error if it fails."""
    result = subprocess.run([str(word) for word in words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                            universal_newlines=True, **options)
    assert result.returncode == 0, result.stdout
    return result.stdout


def build(source, folder, *options, prefixes=None):
    """Configures and builds a project, by default against the installed package.

    Skips if GoogleTest or OpenCV, which it needs, is absent.
    """
    generator = ["-G", "Ninja"] if shutil.which("ninja") else []
    where = ";".join(map(str, prefixes)) if prefixes else extension.cmake_prefix_path()
    configured = subprocess.run(["cmake", "-S", str(source), "-B", str(folder), *generator,
                                 f"-DCMAKE_PREFIX_PATH={where}", *options],
                                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, universal_newlines=True)
    missing = re.search('(?:configuration file provided by "|Could NOT find )(GTest|OpenCV)', configured.stdout)
    if configured.returncode and missing:
        pytest.skip(f"{missing.group(1)} is not installed")
    assert configured.returncode == 0, configured.stdout
    return run("cmake", "--build", folder)


def test_the_command_says_where_cmake_looks(capsys):
    assert main(["info", "--cmake"]) == 0
    ours, torchs = capsys.readouterr().out.strip().split(";")
    assert (Path(ours) / "cmake" / "diff_smoe_rasterization-config.cmake").is_file()
    assert torchs == torch.utils.cmake_prefix_path  # Debian's names a folder without it, and CMake looks where it is


def fields_of(struct):
    """The names of the fields of a struct of dsmoe/torch.h, in order."""
    text = (ROOT / "diff_smoe_rasterization" / "include" / "dsmoe" / "torch.h").read_text()
    body = text.partition(f"struct {struct} {{\n")[2].partition("\n};")[0]
    return re.findall(r"^  [\w:<>, ]+ (\w+)(?: = [^;]*)?;", body, re.MULTILINE)


def test_cpp_has_pythons_names():
    assert (fields_of("GaussianRasterizationSettings")
            == list(settings_module.GaussianRasterizationSettings._fields))
    arguments = list(inspect.signature(diff_smoe_rasterization.rasterize).parameters)
    assert ["means3D", "opacities", "settings", *fields_of("RasterizeArguments")] == arguments
    for name in ("Rendering", "Contributions", "Importance"):
        assert fields_of(name) == list(getattr(settings_module, name)._fields)


@needs_cmake
@pytest.mark.parametrize("name", ["core", "io", "cuda", "torch"])
def test_a_strangers_project_uses_the_package(tmp_path, name):
    if name == "cuda":
        if "cuda" not in extension.BACKENDS:
            with pytest.raises(AssertionError, match="has no dsmoe::cuda"):
                build(CONSUMER, tmp_path, "-DCONSUMER=cuda")
            return
        if not os.path.isdir(os.environ.get("CUDA_HOME", "/usr/local/cuda")):
            pytest.skip("its own calls of CUDA need the toolkit's headers")
    if name == "torch" and diff_smoe_rasterization.build_info()["stable_abi_since"]:
        with pytest.raises(AssertionError, match=r"has\s+no\s+dsmoe::torch"):
            build(CONSUMER, tmp_path, "-DCONSUMER=torch")
        return
    if name == "torch" and not torch._C._GLIBCXX_USE_CXX11_ABI:
        pytest.skip(f"torch {torch.__version__} has the C++ ABI of before 2015, GoogleTest the one since")
    links = ["", "-static-libstdc++"] if os.path.isabs(run("c++", "-print-file-name=libstdc++.a")) else [""]
    for link in links:  # some toolchains link libstdc++ statically by themselves
        build(CONSUMER, tmp_path, f"-DCONSUMER={name}", f"-DCMAKE_EXE_LINKER_FLAGS={link}")
        status = subprocess.run([str(tmp_path / f"consumer_{name}")], cwd=str(tmp_path), stdout=subprocess.PIPE,
                                stderr=subprocess.STDOUT, universal_newlines=True)
        assert status.returncode in ((0, 77) if name == "cuda" else (0,)), (link, status.stdout)


@needs_cmake
@pytest.mark.slow
def test_a_strangers_project_uses_what_cmake_installs(tmp_path):
    """dsmoe::torch by CMake, against find_package(Torch): compiled, installed, and used from outside the tree."""
    if torch.version.cuda:  # libraries of another toolkit, NCCL's among them, would be linked in place of torch's own
        nvcc = os.path.join(os.environ.get("CUDA_HOME", "/usr/local/cuda"), "bin", "nvcc")
        if not os.path.isfile(nvcc) or f"release {torch.version.cuda}," not in run(nvcc, "--version"):
            pytest.skip(f"find_package(Torch) needs a CUDA toolkit {torch.version.cuda} here")
    library_folder = os.path.join(os.path.dirname(torch.__file__), "lib")
    options = [f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}", f"-DCMAKE_LIBRARY_PATH={library_folder}",
               "-DDSMOE_TORCH=ON", "-DDSMOE_CUDA=OFF"]
    configured = subprocess.run(["cmake", "-S", str(ROOT), "-B", str(tmp_path), *options], stdout=subprocess.PIPE,
                                stderr=subprocess.STDOUT, universal_newlines=True)
    assert configured.returncode == 0, configured.stdout
    run("cmake", "--build", tmp_path, "--parallel", os.cpu_count(), "--target", "dsmoe_libraries", "dsmoe_torch")
    run("cmake", "--install", tmp_path, "--prefix", tmp_path / "installed")
    build(CONSUMER, tmp_path / "consumer", "-DCONSUMER=torch", f"-DCMAKE_LIBRARY_PATH={library_folder}",
          prefixes=[tmp_path / "installed", torch.utils.cmake_prefix_path])
    run(tmp_path / "consumer" / "consumer_torch")


@needs_cmake
@pytest.mark.parametrize("library_folder", ["lib", "lib/triplet"])
def test_what_is_installed_finds_the_shared_libraries_beside_it(tmp_path, library_folder):
    """By the folders that CMake's file API says it installs to, and the linker's words for where a program looks."""
    reply = tmp_path / ".cmake" / "api" / "v1" / "reply"
    query = reply.parent / "query" / "codemodel-v2"
    query.parent.mkdir(parents=True)
    query.touch()
    run("cmake", "-S", ROOT, "-B", tmp_path, "-DBUILD_SHARED_LIBS=ON", "-DDSMOE_CUDA=OFF", "-DDSMOE_BUILD_TESTS=OFF",
        "-DCMAKE_BUILD_WITH_INSTALL_RPATH=ON", f"-DCMAKE_INSTALL_LIBDIR={library_folder}")
    linked = set()
    for path in reply.glob("target-*.json"):
        target = json.loads(path.read_text())
        if "install" not in target:
            continue
        folder = target["install"]["destinations"][0]["path"]
        words = " ".join(fragment["fragment"] for fragment in target["link"]["commandFragments"])
        looks = [os.path.normpath(folder + rest)
                 for rest in re.findall(r"(?:ORIGIN|loader_path)([\w./-]*)", words)]
        assert library_folder in looks, (target["name"], words)
        linked.add(target["name"])
    assert {"dsmoe_core", "dsmoe_io"} <= linked  # and the tools, where there is OpenCV


def what_is_found(folder, asked, absent="", before="", prefixes=""):
    """Whether find_package finds this package without the package `absent`, and the targets that come of it."""
    (folder / "CMakeLists.txt").write_text(f"""cmake_minimum_required(VERSION 3.21)
project(program LANGUAGES NONE)
list(APPEND CMAKE_MODULE_PATH "${{CMAKE_CURRENT_LIST_DIR}}")
set(CMAKE_DISABLE_FIND_PACKAGE_{absent or "Nothing"} TRUE)
{before}
find_package(diff_smoe_rasterization QUIET {asked} PATHS "${{CMAKE_CURRENT_LIST_DIR}}")
get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
message(STATUS "found ${{diff_smoe_rasterization_FOUND}} ${{targets}}")
""")
    printed = run("cmake", "-S", folder, "-B", folder / "build", f"-DCMAKE_PREFIX_PATH={prefixes}")
    found, targets = re.search("found (TRUE|FALSE|0|1) (.*)", printed).groups()
    return found in ("TRUE", "1"), {*targets.split(";")}


@needs_cmake
@pytest.mark.parametrize("name, package", [("cuda", "CUDAToolkit"), ("torch", "Torch")])
@pytest.mark.parametrize("asked", ["COMPONENTS", "OPTIONAL_COMPONENTS"])
@pytest.mark.parametrize("is_there", [True, False])
def test_what_a_component_takes_may_be_absent_where_it_is_optional(tmp_path, name, package, asked, is_there):
    """The config that CMake installs, with files of its own in place of the targets and of what these take."""
    for library, file in (("core", "dsmoe_targets.cmake"), (name, f"dsmoe_{name}_targets.cmake")):
        (tmp_path / file).write_text(f"add_library(dsmoe::{library} INTERFACE IMPORTED)\n")
    for found in ("Threads", package):
        (tmp_path / f"Find{found}.cmake").write_text(f"set({found}_FOUND TRUE)\n")
    found, targets = what_is_found(tmp_path, f"{asked} {name}", "" if is_there else package, f"""
set(DSMOE_WITH_CUDA ON)
set(DSMOE_TORCH ON)
include(CMakePackageConfigHelpers)
configure_package_config_file({ROOT}/build_support/config.cmake.in
  "${{CMAKE_CURRENT_LIST_DIR}}/diff_smoe_rasterization-config.cmake" INSTALL_DESTINATION .)""")
    assert found == (is_there or asked == "OPTIONAL_COMPONENTS")
    assert targets == {"dsmoe::core", *([f"dsmoe::{name}"] if is_there else [])}


def package_built_against(folder, torch_version, cuda_version, stable_abi_since=None):
    """A copy of the installed package's config that says so, in `folder`; returns where CMake has to look."""
    package = folder / "site" / "diff_smoe_rasterization"
    shutil.copytree(str(INSTALLED / "cmake"), str(package / "cmake"))
    shutil.copy(str(INSTALLED / "_version.py"), str(package))
    (package / "_build_info.py").write_text(
        f"TORCH_VERSION = {torch_version!r}\nCUDA_VERSION = {cuda_version!r}\nCXX11_ABI = True\n"
        f"STABLE_ABI_SINCE = {stable_abi_since!r}\n")
    return extension.cmake_prefix_path().replace(str(INSTALLED), str(package))


@needs_cmake
def test_a_package_of_another_torch_has_all_but_the_ops(tmp_path):
    prefixes = package_built_against(tmp_path, "0.4.1", None)
    assert what_is_found(tmp_path, "COMPONENTS core io", prefixes=prefixes) == (True, {"dsmoe::core", "dsmoe::io"})
    result = subprocess.run(["cmake", "-S", str(CONSUMER), "-B", str(tmp_path / "torch"), "-DCONSUMER=torch",
                             f"-DCMAKE_PREFIX_PATH={prefixes}"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                            universal_newlines=True)
    assert result.returncode != 0
    assert "built against torch 0.4.1" in " ".join(result.stdout.split())


@needs_cmake
@pytest.mark.parametrize("asked, found", [("COMPONENTS core io", True), ("COMPONENTS torch", False)])
def test_a_package_by_the_stable_abi_needs_no_torch_and_has_no_target_of_it(tmp_path, asked, found):
    prefixes = package_built_against(tmp_path, "0.4.1", None, stable_abi_since="0.4")
    assert what_is_found(tmp_path, asked, prefixes=prefixes) == (found, {"dsmoe::core", "dsmoe::io"})


@needs_cmake
@pytest.mark.parametrize("asked, found", [("COMPONENTS cuda", False), ("OPTIONAL_COMPONENTS cuda", True), ("", True)])
def test_a_package_with_kernels_is_found_without_a_toolkit(tmp_path, asked, found):
    prefixes = package_built_against(tmp_path, torch.__version__, "13.0")
    actual, targets = what_is_found(tmp_path, asked, "CUDAToolkit", prefixes=prefixes)
    assert actual == found and "dsmoe::cuda" in targets


@needs_cmake
def test_a_component_that_is_none_is_said_with_those_that_are(tmp_path):
    (tmp_path / "CMakeLists.txt").write_text("""cmake_minimum_required(VERSION 3.21)
project(program LANGUAGES NONE)
find_package(diff_smoe_rasterization REQUIRED COMPONENTS gpu)
""")
    with pytest.raises(AssertionError) as error:
        run("cmake", "-S", tmp_path, "-B", tmp_path / "build", f"-DCMAKE_PREFIX_PATH={extension.cmake_prefix_path()}")
    text = " ".join(str(error.value).split())
    assert "There is no component gpu; the components are core, io, cuda and torch." in text


def documented_programs():
    """The programs of docs/cpp.md and examples/cpp, by the targets that the comment in their first line names."""
    page = (ROOT / "docs" / "cpp.md").read_text(encoding="utf-8")
    programs = re.findall(r"```cpp\n(.*?)```", page, re.DOTALL)
    for path in sorted((ROOT / "examples" / "cpp").glob("*.cpp")):
        assert f"(../examples/cpp/{path.name})" in page
        programs.append(path.read_text(encoding="utf-8"))
    return {re.match(r"// (dsmoe::\w+(?: and dsmoe::\w+)*)", text)[1].replace("dsmoe::", ""): text for text in programs}


def test_every_target_is_documented_by_a_program():
    assert sorted(documented_programs()) == ["core", "core and io", "cuda", "io", "torch"]


@needs_cmake
@pytest.mark.parametrize("name", ["core", "core and io", "io", pytest.param("cuda", marks=pytest.mark.slow),
                                  pytest.param("torch", marks=pytest.mark.slow)])
def test_documented_programs_are_built_and_run(tmp_path, name):
    if name == "cuda" and "cuda" not in extension.BACKENDS:
        pytest.skip("built without CUDA")
    if name == "torch" and diff_smoe_rasterization.build_info()["stable_abi_since"]:
        pytest.skip("built by the stable ABI")
    (tmp_path / "program.cpp").write_text(documented_programs()[name])
    (tmp_path / "CMakeLists.txt").write_text(f"""cmake_minimum_required(VERSION 3.21)
project(program LANGUAGES CXX)
find_package(diff_smoe_rasterization 0.1 REQUIRED COMPONENTS {" ".join(name.split(" and "))})
add_executable(program program.cpp)
target_link_libraries(program PRIVATE {" ".join("dsmoe::" + one for one in name.split(" and "))})
""")
    build(tmp_path, tmp_path / "build")
    if name == "core and io":
        shows_a_model(tmp_path / "build" / "program", tmp_path)
    elif name != "cuda":  # its program needs a GPU
        run(tmp_path / "build" / "program", cwd=str(tmp_path))


def shows_a_model(program, folder):
    """Whether the program renders a .ply as Python does, and says in a line what is wrong with another file."""
    random = np.random.RandomState(0)
    count, degree = 200, 2
    model = diff_smoe_rasterization.io.Gaussians(
        means3D=random.randn(count, 3), dc=random.rand(count, 1, 3), shs=random.randn(count, 8, 3) * 0.2,
        opacity_logits=random.randn(count, 1), log_scales=random.randn(count, 3) * 0.3 - 2.5,
        rotations=random.randn(count, 4), blend_mode="smoe", background_gate=0.05, comments=("faint_below 2",))
    diff_smoe_rasterization.io.write_gaussians(str(folder / "model.ply"), model)
    run(program, folder / "model.ply", folder / "image.ppm")
    settings = diff_smoe_rasterization.settings_from_camera(
        [[400, 0, 200], [0, 400, 150], [0, 0, 1]], torch.eye(3), torch.tensor([0.0, 0.0, 4.0]), 400, 300,
        blend_mode="smoe", background_gate=0.05, faint_below=2.0, sh_degree=degree)
    tensors = {name: torch.tensor(getattr(model, name), dtype=torch.float32)
               for name in ("means3D", "dc", "shs", "opacity_logits", "log_scales", "rotations")}
    arguments = {
        "means3D": tensors["means3D"], "shs": torch.cat([tensors["dc"], tensors["shs"]], dim=1),
        "opacities": tensors["opacity_logits"].sigmoid(), "scales": tensors["log_scales"].exp(),
        "rotations": torch.nn.functional.normalize(tensors["rotations"])}
    expected = diff_smoe_rasterization.rasterize(settings=settings, **arguments).color
    usual = diff_smoe_rasterization.rasterize(settings=settings._replace(faint_below=None), **arguments).color
    assert (usual - expected).abs().max() > 3 / 255, "the image tells whether faint_below is the file's"
    with Image.open(folder / "image.ppm") as image:
        shown = np.asarray(image).astype(int)
    assert expected.mean() > 0.1
    # One step, if exp or sigmoid of torch is another float.
    assert np.abs(shown - (expected.clamp(0, 1) * 255).round().permute(1, 2, 0).numpy()).max() <= 1
    (folder / "other.ply").write_text("ply\n")
    result = subprocess.run([str(program), str(folder / "other.ply"), str(folder / "other.ppm")],
                            stderr=subprocess.PIPE, universal_newlines=True)
    assert result.returncode == 1 and "other.ply" in result.stderr and result.stderr.count("\n") == 1


@pytest.fixture
def cpp_trainer(tmp_path_factory):
    """The program of examples/libtorch, built once."""
    folder = tmp_path_factory.getbasetemp() / "cpp_trainer"
    if not (folder / "train").is_file():
        build(ROOT / "examples" / "libtorch", folder, "-DCMAKE_BUILD_TYPE=Release")
    return folder / "train"


@needs_cmake
@pytest.mark.slow
def test_the_cpp_trainer_refuses_what_it_would_ignore_or_lose(cpp_trainer, tmp_path):
    write_synthetic_scene(str(tmp_path / "scene"), views=9, width=20, height=15, points=50, supersampling=1)

    def said(*options, status=1):
        done = subprocess.run([str(cpp_trainer), str(tmp_path / "scene"), str(tmp_path / "out"), "--iterations", "2",
                               *options], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, universal_newlines=True)
        assert done.returncode == status, done.stderr
        return done.stderr

    assert said("--background-gate", "0.5") == "--background-gate is for --blend-mode smoe and smoe_eq7 only\n"
    assert (said("--blend-mode", "smoe", "--background-gate", "0.5x")
            == '--background-gate is "0.5x"; it must be learned, or a number from 0 to 1e30\n')
    assert (said("--blend-mode", "smo", "--background-gate", "0.5")
            == '--blend-mode is "smo"; it must be one of alpha, smoe, smoe_eq7, smoe_tn, smoe_std\n')
    for name, least, wrong in (("--iterations", 1, ("1e4", "0", "-5", "2147483648")),
                               ("--divisor", 1, ("2x", "1.5", "0")), ("--seed", 0, ("abc", "-1", ""))):
        for value in wrong:
            assert said(name, value).startswith(f'{name} is "{value}"; it must be a whole number from {least} to ')
    assert said("--seed") == "--seed needs a value\n" and said("--sed", "0") == "there is no option --sed\n"
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").write_text("mine")
    refused = said()
    assert "out/point_cloud/iteration_2\" cannot be made: Not a directory; OUT must be" in refused
    assert "it/s" not in refused, "it trained before it said so"
    (tmp_path / "out").unlink()
    said(status=0)
    model = tmp_path / "out" / "point_cloud" / "iteration_2" / "point_cloud.ply"
    first = model.read_bytes()
    assert said("--seed", "1") == f'"{model}" is there already; --overwrite replaces it, another OUT keeps it\n'
    assert model.read_bytes() == first
    said("--overwrite", "--seed", "1", "--blend-mode", "smoe", status=0)
    assert model.read_bytes() != first


@needs_cmake
@pytest.mark.slow
@pytest.mark.parametrize("options", [[], ["--blend-mode", "smoe"], ["--blend-mode", "smoe", "--background-gate", "0"]])
def test_the_cpp_trainer_is_as_good_as_pythons(cpp_trainer, tmp_path, options):
    """Same scene, recipe and number of steps; the order of views and the places of split Gaussians are others."""
    write_synthetic_scene(str(tmp_path / "scene"), views=24, width=100, height=75, points=1000, supersampling=1)
    printed = run(cpp_trainer, tmp_path / "scene", tmp_path / "cpp", "--iterations", "300", *options)
    if not options:
        wrong = subprocess.run([str(cpp_trainer), str(tmp_path / "scene"), str(tmp_path / "no"), "--device",
                                "quark"], stderr=subprocess.PIPE, universal_newlines=True)
        assert wrong.returncode == 1 and "quark" in wrong.stderr
        assert wrong.stderr.count("\n") == 1, "without the trace of LibTorch's errors"
    ours = float(re.search(r"test PSNR ([0-9.]+) dB", printed).group(1))
    assert main(["train", str(tmp_path / "scene"), "-o", str(tmp_path / "python"), "--iterations", "300", "--quiet",
                 "--strategy", "3dgs", "--scale-recipe", *options]) == 0
    theirs = json.loads((tmp_path / "python" / "results.json").read_text())[0]
    assert abs(ours - theirs["psnr"]) < 1, (ours, theirs["psnr"])  # seeds of one program differ by up to 0.9 here
    model = diff_smoe_rasterization.io.read_gaussians(
        str(tmp_path / "cpp" / "point_cloud" / "iteration_300" / "point_cloud.ply"))
    assert abs(len(model.means3D) / theirs["num_gaussians"] - 1) < 0.1  # seeds: 5%
    assert model.blend_mode == (options[1] if options else "alpha")
    assert (model.background_gate is not None) == (model.blend_mode != "alpha")
    if "--background-gate" in options:
        assert model.background_gate == 0
