"""`dsmoe run` and `dsmoe patch` as commands: what the child sees, what is refused, and the exit status."""
from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import diff_smoe_rasterization
from diff_smoe_rasterization import cli, patches
from diff_smoe_rasterization.patches import run
from diff_smoe_rasterization.settings import BLEND_MODES, RECOMMENDED_BACKGROUND_GATE
from test_patch_engine import GR, RENDERER, make, snapshot

SHOW = """import importlib, os, sys
sys.path.insert(0, "")
import diff_gaussian_rasterization
names = [name for name in sys.argv[1:] if hasattr(diff_gaussian_rasterization, name)]
print(diff_gaussian_rasterization.GaussianRasterizer.__module__, os.environ["DSMOE_BLEND_MODE"], *names)
try:
    from diff_gaussian_rasterization._C import fusedssim
except ImportError:
    print("no _C")
import gaussian_renderer
sys.exit(7)
"""


def environment():
    """This Python's package and programs, whether it is installed or not, and no blend mode."""
    above = str(Path(diff_smoe_rasterization.__file__).resolve().parent.parent)
    return {**{name: value for name, value in os.environ.items() if not name.startswith("DSMOE_B")},
            "PYTHONPATH": os.pathsep.join(filter(None, [above, os.environ.get("PYTHONPATH")])),
            "PATH": os.path.dirname(sys.executable) + os.pathsep + os.environ["PATH"]}


def dsmoe_alone(*words, cwd):
    """The command in a process of its own, as `dsmoe run` becomes what it runs."""
    return subprocess.run([sys.executable, "-m", "diff_smoe_rasterization", *map(str, words)], cwd=str(cwd),
                          env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, universal_newlines=True)


@pytest.fixture
def dsmoe(monkeypatch, capsys):
    """The command in this process, which has imported torch already."""
    for name in ("PYTHONPATH", "PATH"):
        monkeypatch.setenv(name, environment()[name])

    def call(*words, cwd):
        monkeypatch.chdir(cwd)
        capsys.readouterr()
        try:
            status = cli.main(list(map(str, words)))
        except SystemExit as error:
            status = error.code
        printed = capsys.readouterr()
        return SimpleNamespace(returncode=status, stdout=printed.out, stderr=printed.err)

    return call


def refused(result, *words):
    assert result.returncode == 1 and "Traceback" not in result.stderr
    for word in words:
        assert word in result.stderr, result.stderr


def test_an_unmodified_checkout_runs_and_stays_as_it_was(tmp_path):
    """The script's folder says which trainer it is; a child of the child has the same rasterizer and mode."""
    checkout = make(tmp_path / "a trainer", {"show.py": SHOW, "parent.py": "import os, sys\n"
                                             f"os.chdir({str(tmp_path / 'a trainer')!r})\n"
                                             "sys.exit(os.system(sys.executable + ' show.py') >> 8)\n"})
    before = snapshot(tmp_path)
    result = dsmoe_alone("run", "--blend-mode", "smoe", "--background-gate", "0.25", "--", sys.executable,
                         checkout / "parent.py", cwd=tmp_path)
    assert result.returncode == 7, result.stderr
    assert result.stdout.splitlines() == ["diff_smoe_rasterization.rasterizer smoe", "no _C"]
    announced, *said = result.stderr.splitlines()
    words = "of this package, blend mode smoe, background gate 0.25"
    assert "3dgs-2023" in announced and "will be inria " + words in announced
    assert said == ["diff_smoe_rasterization: the rasterizer is inria " + words]
    assert snapshot(tmp_path) == before


def test_a_command_that_takes_the_path_away_says_nothing(tmp_path):
    """What the first line announces has come true where a process says so itself."""
    checkout = make(tmp_path, {"show.py": "import importlib.util\n"
                               "assert importlib.util.find_spec('diff_gaussian_rasterization') is None\n",
                               "go.sh": f'PYTHONPATH=. "{sys.executable}" show.py\n'})
    result = dsmoe_alone("run", "--blend-mode", "smoe", "--", "bash", "go.sh", cwd=checkout)
    assert result.returncode == 0, result.stderr
    assert "will be inria" in result.stderr and "the rasterizer is" not in result.stderr


def test_signals_and_status_are_the_commands(tmp_path):
    """dsmoe becomes the command: a signal to the one is a signal to the other."""
    wait = "import signal, sys, time; print('ready', flush=True); time.sleep(600)"
    words = ["run", "--blend-mode", "smoe", "--trainer", "inria", "--", sys.executable, "-c", wait]
    process = subprocess.Popen([sys.executable, "-m", "diff_smoe_rasterization", *words], cwd=str(tmp_path),
                               env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout.readline() == b"ready\n"
    process.terminate()
    process.communicate()
    assert process.returncode == -signal.SIGTERM


def test_every_shim_has_its_module():
    assert set(run.flavours()) >= {known.flavour for known in run.TRAINERS}
    for flavour in run.flavours():
        text = (run.SHIMS / flavour / "diff_gaussian_rasterization/__init__.py").read_text()
        assert f"from diff_smoe_rasterization.integrations.{flavour} import *" in text
        assert f'say_rasterizer("{flavour}")' in text


def test_a_stand_in_says_that_it_is_used(tmp_path):
    """Each that is used, and no other."""
    code = "from simple_knn._C import distCUDA2; import fused_ssim; fused_ssim.fused_ssim"
    shims = [str(run.SHIMS / name) for name in ("simple_knn", "fused_ssim", "weighted_distance")]
    variables = {**environment(), "PYTHONPATH": os.pathsep.join([*shims, environment()["PYTHONPATH"]])}
    result = subprocess.run([sys.executable, "-c", code], env=variables, cwd=str(tmp_path), stderr=subprocess.PIPE,
                            universal_newlines=True)
    assert result.returncode == 0, result.stderr
    assert [line.split()[1] for line in result.stderr.splitlines()] == ["simple_knn", "fused_ssim"]


def test_another_trainer_runs_by_the_name_of_its_rasterizer(tmp_path, dsmoe):
    words = [sys.executable, "show.py"]
    made, _ = run.prepare(words, "smoe", "scaffold", environment())
    assert made["PYTHONPATH"].startswith(str(run.SHIMS / "scaffold") + os.pathsep)
    refused(dsmoe("run", "--blend-mode", "smoe", "--", *words, cwd=tmp_path), "--trainer", "scaffold", "inria_2024")
    refused(dsmoe("run", "--blend-mode", "smoe", "--trainer", "nerf", "--", *words, cwd=tmp_path), "no trainer 'nerf'",
            "3dgs-2023", "scaffold")


def test_the_blend_mode_has_to_be_said(tmp_path, dsmoe):
    result = dsmoe("run", "--", sys.executable, "train.py", cwd=make(tmp_path))
    assert result.returncode == 2 and "--blend-mode" in result.stderr
    for spelling in ("--blend-mode", "--blend_mode"):  # the second is a patched trainer's
        refused(dsmoe("run", spelling, "smoe", "--", cwd=tmp_path), "there is no command")
    refused(dsmoe("run", "--blend-mode", "smoe", "--background_gate", "0", "--", cwd=tmp_path), "there is no command")


@pytest.mark.parametrize("mode", BLEND_MODES)
def test_the_gate_of_the_children(mode, tmp_path, monkeypatch, dsmoe):
    """That which is asked for, else the variable's, else the recommended one; and none in other modes than smoe."""
    words = [sys.executable, "show.py"]
    monkeypatch.setattr(run, "_ask_python", lambda *_: ({"usable": run.STAND_INS.values()}, []))  # takes seconds
    for variable, asked, gate in (("", None, RECOMMENDED_BACKGROUND_GATE), ("0.25", None, 0.25), ("0.25", 0.0, 0.0)):
        monkeypatch.setenv("DSMOE_BACKGROUND_GATE", variable)
        if mode == "smoe" or asked is None:
            made, lines = run.prepare(words, mode, "scaffold", dict(os.environ), asked)
            assert made.get("DSMOE_BACKGROUND_GATE") == (str(gate) if mode == "smoe" else None)
            assert (f"blend mode {mode}, background gate {gate};" in lines[0]) == (mode == "smoe")
    for gate in ("-1", "nan") if mode == "smoe" else ("0.1",):
        refused(dsmoe("run", "--blend-mode", mode, "--background-gate", gate, "--trainer", "scaffold", "--", *words,
                      cwd=tmp_path), "background_gate is")


def test_what_would_not_use_the_rasterizer_is_refused(tmp_path, dsmoe):
    checkout = make(tmp_path / "trainer")
    words = ("run", "--blend-mode", "smoe", "--")
    refused(dsmoe(*words, cwd=checkout), "there is no command")
    refused(dsmoe(*words, "no-such-command", cwd=checkout), "no-such-command")
    (checkout / "tool.py").write_text("")
    refused(dsmoe(*words, "./tool.py", cwd=checkout), "./tool.py: is not executable; type: python ./tool.py")
    for options in ("-I", "-sE", "-W ignore -E", "-uX dev -E", "-Wignore -Es", "--check-hash-based-pycs always -I"):
        refused(dsmoe(*words, sys.executable, *options.split(), "train.py", cwd=checkout), "PYTHONPATH")
    for options in ("-WIgnore", "-W Ignore", "-X E", "-cE", "-m E", "train.py -E", "- -E", "-u -- train.py -I"):
        assert not set("IE") & set(run._python_options(options.split()))  # of the program, or values
    (tmp_path / "diff_gaussian_rasterization").mkdir()  # above the checkout, where no Python looks
    run.prepare([sys.executable, str(checkout / "train.py")], "smoe", None, environment())
    (checkout / "diff_gaussian_rasterization.py").write_text("")
    refused(dsmoe(*words, sys.executable, "train.py", cwd=checkout), "diff_gaussian_rasterization.py would be imported")
    (checkout / "diff_gaussian_rasterization.py").unlink()
    (checkout / "diff_gaussian_rasterization").mkdir()
    refused(dsmoe(*words, sys.executable, "train.py", cwd=checkout), "diff_gaussian_rasterization would be imported")
    patched = make(tmp_path / "patched", {GR: RENDERER.replace("diff_gaussian_rasterization import",
                                                                "diff_smoe_rasterization.integrations.inria import")})
    refused(dsmoe(*words, sys.executable, "train.py", cwd=patched), "patched already", "--blend_mode")


def test_a_python_without_the_package_is_named(tmp_path, dsmoe):
    other = tmp_path / "python3"  # a Python that finds nothing but its own library
    other.write_text(f'#!/bin/sh\nexec env -u PYTHONPATH "{sys.executable}" -I -S "$@"\n')
    other.chmod(0o755)
    result = dsmoe("run", "--blend-mode", "smoe", "--", other, "train.py", cwd=make(tmp_path / "trainer"))
    refused(result, str(other), "cannot import diff_smoe_rasterization", "pip install")


def test_stand_ins_only_for_what_is_missing(tmp_path):
    """What the command's Python can import itself is left to it."""
    (tmp_path / "packages/simple_knn").mkdir(parents=True)
    (tmp_path / "packages/simple_knn/__init__.py").write_text("")
    (tmp_path / "packages/simple_knn/_C.py").write_text("distCUDA2 = None\n")
    variables = environment()
    variables["PYTHONPATH"] = f"{tmp_path / 'packages'}{os.pathsep}{variables['PYTHONPATH']}"
    made, lines = run.prepare([sys.executable, "x.py"], "smoe", "hac", variables)
    first = made["PYTHONPATH"].split(os.pathsep)[:2]
    assert first[0] == str(run.SHIMS / "scaffold") and str(run.SHIMS / "simple_knn") not in made["PYTHONPATH"]
    assert made["PYTHONPATH"].endswith(variables["PYTHONPATH"]) and made["DSMOE_BLEND_MODE"] == "smoe"
    assert not any("simple_knn" in line for line in lines)


def test_the_patch_commands(tmp_path, dsmoe):
    pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")
    checkout = make(tmp_path / "a trainer")
    before = snapshot(checkout)
    assert "patchable (3dgs-2023)" in dsmoe("patch", "check", checkout, cwd=tmp_path).stdout
    shown = dsmoe("patch", "apply", checkout, "--dry-run", cwd=tmp_path)
    assert shown.returncode == 0 and shown.stdout == patches.diff(checkout)
    assert snapshot(checkout) == before
    applied = dsmoe("patch", "apply", checkout, cwd=tmp_path)
    assert applied.returncode == 0 and "train.py: pipe-blend-mode" in applied.stdout
    again = dsmoe("patch", "apply", checkout, cwd=tmp_path)
    assert again.returncode == 0 and "already patched" in again.stdout
    assert dsmoe("patch", "revert", checkout, cwd=tmp_path).returncode == 0
    assert snapshot(checkout) == before
    refused(dsmoe("patch", "revert", checkout, cwd=tmp_path), ".dsmoe_patch")
    (checkout / "train.py").write_text("def fit():\n    pass\n")
    checked = dsmoe("patch", "check", checkout, cwd=tmp_path)
    assert "drifted" in checked.stdout
    for result in (checked, dsmoe("patch", "apply", checkout, cwd=tmp_path)):
        refused(result, "train.py", "pipe-blend-mode", "0 matches instead of 1")


def test_without_libcst_patching_says_what_to_type(tmp_path, monkeypatch, dsmoe):
    monkeypatch.setitem(sys.modules, "libcst", None)  # an import of it fails
    refused(dsmoe("patch", "apply", make(tmp_path / "checkout"), cwd=tmp_path), "pip install libcst")


def test_the_package_brings_the_shims_and_nothing_beside_itself():
    """Not one of the names that the shims stand in for is installed as such."""
    root = Path(__file__).resolve().parents[3]
    pytest.importorskip("setuptools")
    spec = importlib.util.spec_from_file_location("dsmoe_setup", root / "setup.py")
    setup = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(setup)
    packages = setup.packages()
    assert {name.partition(".")[0] for name in packages["packages"]} == {"diff_smoe_rasterization"}
    assert {"diff_smoe_rasterization.patches", "diff_smoe_rasterization.patches.trainers"} <= set(packages["packages"])
    brought = {path for pattern in packages["package_data"]["diff_smoe_rasterization.patches"]
               for path in (root / "patches").glob(pattern)}
    assert brought == set((root / "patches/shims").rglob("*.py")) != set()
    names = {folder.name for folder in run.SHIMS.iterdir()}  # of the package that runs here, installed or not
    assert names == set(run.flavours()) | set(run.STAND_INS)
