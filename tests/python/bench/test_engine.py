"""From a suite to rows: what is done is not done again, what fails is a row, what is killed continues."""
from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from bench_commands import command, environment, rows_of, wait_for

from diff_smoe_rasterization.benchmarks.errors import BenchError
from diff_smoe_rasterization.benchmarks.suite import engine, selection
from diff_smoe_rasterization.benchmarks.suite.cell import failed_row
from diff_smoe_rasterization.benchmarks.suite.expansion import expand
from diff_smoe_rasterization.benchmarks.suite.names import blend_of
from diff_smoe_rasterization.cli import main
from diff_smoe_rasterization.trainer.errors import TrainerError

yaml = pytest.importorskip("yaml", reason="suites are YAML files: pip install pyyaml")
snakemake = pytest.importorskip("snakemake", reason="the engine is Snakemake: pip install snakemake")


def write_suite(content, folder):
    path = Path(folder) / "suite.yaml"
    path.write_text(yaml.safe_dump(content))
    return str(path)


@pytest.fixture(scope="module")
def finished(tmp_path_factory, tiny_scene):
    """A suite of one cell that works and one that cannot."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "nothing").mkdir()
    shadow = folder / "results" / "diff_smoe_rasterization" / "__init__.py"  # is not what cells import
    shadow.parent.mkdir(parents=True)
    shadow.write_text("raise ImportError('of the folder in which cells are run')\n")
    content = {"name": "two", "protocol": {"iterations": 12, "device": "cpu", "principal_point": "scene", "lpips": [],
                                           "evaluate_every": 6},
               "scenes": [{"name": "tiny", "path": tiny_scene}, {"name": "absent", "path": str(folder / "nothing")}],
               "methods": [{"name": "native"}], "blend_modes": ["smoe"], "densify_grad_thresholds": [0.005],
               "images": 1}
    suite = write_suite(content, folder)
    assert main(["bench", "run", suite, "-o", str(folder / "results"), "--jobs", "2"]) == 1
    return content, suite, folder / "results"


@pytest.fixture
def copied(finished, tmp_path):
    """The results of that suite once more, to be changed."""
    return Path(shutil.copytree(finished[2], tmp_path / "results"))


def test_a_row_says_what_was_measured_and_how(finished):
    row, = [row for row in rows_of(finished[2]).values() if row["ok"]]
    for name in ("psnr", "psnr_float", "ssim", "psnr_edge", "train_seconds", "wall_seconds", "fps"):
        assert row[name] > 0, name
    assert (row["method"], row["variant"], row["blend_mode"], row["schedule"]) == ("native", "native", "smoe", "3dgs")
    assert row["background_gate"] == row["protocol"]["background_gate"] == 0
    assert row["size_bytes"]["common"] == row["num_gaussians"] * 236  # 59 numbers of 4 bytes
    assert row["size_bytes"]["own"] > row["size_bytes"]["common"]  # the file has normals and a header beside them
    protocol = row["protocol"]
    assert protocol["image_size"] == [32, 24] and protocol["test_views"] == len(row["per_view"]) == 2
    assert protocol["downscaler"] == "none: files of images as supplied"
    for name in ("split", "background", "principal_point", "psnr", "ssim", "fps", "size", "psnr_edge", "seed"):
        assert protocol[name] is not None, name
    assert [point["iteration"] for point in row["history"]] == [6]
    assert row["lpips"]["value"] is None and row["lpips"]["reason"]
    assert row["train_seconds"] < row["wall_seconds"]
    assert row["machine"]["cells_at_once"] == 2  # --jobs 2, two cells


def test_the_report_of_a_run_holds_what_its_rows_say(finished, tmp_path):
    pytest.importorskip("matplotlib", reason="a report needs matplotlib")
    assert main(["bench", "report", str(finished[2]), "-o", str(tmp_path)]) == 0
    rows = {row["ok"]: row for row in rows_of(finished[2]).values()}
    found = {}
    for name in ("cells", "failures"):
        with open(tmp_path / "tables" / f"two_{name}.csv", encoding="utf-8", newline="") as file:
            found[name] = list(csv.DictReader(file))
    measured = next(line for line in found["cells"] if line["scene"] == "tiny")
    assert float(measured["PSNR [dB]"]) == rows[True]["psnr"]
    assert int(measured["#Gaussians"]) == rows[True]["num_gaussians"]
    failed, = found["failures"]
    assert (failed["cell"], failed["reason"]) == (rows[False]["cell"], rows[False]["reason"])
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    for part in ('id="two_cells"', 'data-scene="tiny"', "data:image/svg+xml", "2 cells on 2 scenes, 1 seed; 1 failed"):
        assert part in page, part
    assert len(list((tmp_path / "images").rglob("*.png"))) == 3  # the truth, a rendering, its error


def test_what_is_done_is_not_done_again(finished, capsys):
    _, suite, results = finished
    before = {path: path.read_text() for path in results.glob("cells/*/log.txt")}
    assert len(before) == 2
    assert main(["bench", "run", suite, "-o", str(results)]) == 1
    assert {path: path.read_text() for path in before} == before
    capsys.readouterr()
    for words, states, counts in (([], ["done", "failed"], "1 done, 0 to do, 1 failed"),
                                  (["--retry-failed"], ["done", "to"], "1 done, 1 to do, 0 failed")):
        assert main(["bench", "run", suite, "-o", str(results), "--dry-run", *words]) == 0
        *lines, summary = capsys.readouterr().out.splitlines()
        assert [line.split()[0] for line in lines] == states and summary == counts


@pytest.mark.slow
@pytest.mark.parametrize("words", [[], ["--retry-failed"]])
def test_a_failed_cell_is_tried_again_where_its_path_has_changed(words, copied, finished, tmp_path):
    """The reason is gone, and only the cell that failed is run."""
    content, _, _ = finished
    there, absent = content["scenes"]
    moved = {**content, "scenes": [there, {**absent, "path": there["path"]}]}
    suite = write_suite(moved, tmp_path)
    logs = {path.parent.name: path.read_text() for path in copied.glob("cells/*/log.txt")}
    assert main(["bench", "run", suite, "-o", str(copied), *words]) == 0
    rows = rows_of(copied)
    assert set(rows) == set(logs) and all(row["ok"] for row in rows.values())
    changed = {name for name in logs if (copied / "cells" / name / "log.txt").read_text() != logs[name]}
    assert changed == {name for name, row in rows.items() if row["scene"] == "absent"}


def test_rows_of_an_earlier_run_elsewhere_are_not_run_again(finished, tmp_path, capsys):
    _, suite, results = finished
    rows = ["--rows", str(results / "rows.jsonl")]
    assert main(["bench", "run", suite, "-o", str(tmp_path / "dry"), "--dry-run", *rows]) == 0
    assert capsys.readouterr().out.splitlines()[0] == f"2 of 2 cells taken from {rows[1]}"
    assert not (tmp_path / "dry").exists()
    assert main(["bench", "run", suite, "-o", str(tmp_path / "dry"), "--dry-run", "--retry-failed", *rows]) == 0
    counted, *lines, _ = capsys.readouterr().out.splitlines()
    assert counted.startswith("1 of 2 cells") and [line.split()[0] for line in lines] == ["done", "to"]
    assert main(["bench", "run", suite, "-o", str(tmp_path / "new"), *rows]) == 1  # one failed
    assert rows_of(tmp_path / "new") == rows_of(results)
    assert not list((tmp_path / "new").glob("cells/*/log.txt"))
    other = write_suite({**finished[0], "name": "other"}, tmp_path)
    assert main(["bench", "run", other, "-o", str(tmp_path / "other"), *rows]) == 1
    assert {row["suite"] for row in rows_of(tmp_path / "other").values()} == {"other"}
    assert main(["bench", "run", suite, "-o", str(tmp_path / "none"), "--rows", str(tmp_path / "absent.jsonl")]) == 1
    assert "absent.jsonl" in capsys.readouterr().err


def test_where_all_is_done_nothing_is_needed(finished, tmp_path, monkeypatch):
    """Neither Snakemake nor, for a suite for GPUs, a GPU; the suite's file lists all cells, chosen or not."""
    monkeypatch.setattr(engine.importlib.util, "find_spec", lambda name: None if "snakemake" in name else object())
    monkeypatch.setattr(engine, "visible_gpus", list)
    content = {**finished[0], "protocol": {**finished[0]["protocol"], "device": "cuda"}}
    wanted = expand(content, "").cells
    (tmp_path / "rows.jsonl").write_text("".join(done_row(cell) + "\n" for cell in wanted))
    words = ["bench", "run", write_suite(content, tmp_path), "-o", str(tmp_path / "results")]
    assert main([*words, "--rows", str(tmp_path / "rows.jsonl"), "--only", "scene=tiny"]) == 0
    assert set(rows_of(tmp_path / "results")) == {wanted[0]["id"]}
    said = json.loads((tmp_path / "results" / "suite.json").read_text())
    assert said["cells"] == [cell["id"] for cell in wanted] and len(wanted) == 2 and said["name"] == "two"
    assert main([*words, "--only", "scene=tiny"]) == 0  # without --rows: it is there
    assert main(words) == 1  # the other one is not


def done_row(cell):
    """A line that says that a cell worked."""
    return json.dumps({**failed_row(cell, "", 1.0), "ok": True, "psnr": 20.0, "num_gaussians": 5})


@pytest.mark.parametrize("damaged", ["{}", "[]", "3", "null", '{"ok": true}', "", "another cell's"])
def test_a_damaged_row_is_named_before_anything_is_run(damaged, copied, finished, capsys):
    _, suite, _ = finished
    one, other = sorted(copied.glob("cells/*/row.json"))
    one.write_text(other.read_text() if damaged == "another cell's" else damaged)
    for more in ([], ["--dry-run"], ["--only", f"scene={json.loads(other.read_text())['scene']}"]):
        assert main(["bench", "run", suite, "-o", str(copied), *more]) == 1
        told = capsys.readouterr().err
        assert f"error: {one}: " in told and "remove it to have it made anew" in told
    one.unlink()
    assert main(["bench", "run", suite, "-o", str(copied), "--dry-run"]) == 0
    assert "1 to do" in capsys.readouterr().out


def test_rows_must_be_of_the_suites_cells(finished, tmp_path, capsys):
    content, suite, results = finished
    longer = write_suite({**content, "protocol": {**content["protocol"], "iterations": 13}}, tmp_path)
    words = ["-o", str(tmp_path / "results"), "--rows"]
    assert main(["bench", "run", longer, *words, str(results)]) == 1
    assert "none of its 2 rows is of a cell" in capsys.readouterr().err
    rows = list(rows_of(results).values())
    for field in selection.SAID_BY_THE_ID:
        changed, value = tmp_path / f"{field}.jsonl", rows[1][field]
        other = {**rows[1], field: "other" if isinstance(value, str) else value + 1}
        changed.write_text(json.dumps(rows[0]) + "\n" + json.dumps(other) + "\n")
        assert main(["bench", "run", suite, *words, str(changed)]) == 1
        told = capsys.readouterr().err
        assert str(changed) in told and rows[1]["cell"] in told and f": {field} is " in told
    assert not (tmp_path / "results").exists()


def test_options_that_do_not_go_together_are_refused_before_anything_is_written(content, tmp_path, capsys):
    suite, results = write_suite(content, tmp_path), tmp_path / "results"
    for words, told in ((["--jobs", "0"], "--jobs is 0"), (["--per-gpu", "-1"], "--per-gpu is -1"),
                        (["--per-gpu", "2"], "protocol.device cuda"),
                        (["--per-gpu", "2", "--slurm"], "without --slurm"),
                        (["--slurm", "gpu"], "--slurm gpu: must be KEY=VALUE"),
                        (["--slurm", "=gpu"], "--slurm =gpu: must be KEY=VALUE")):
        for more in ([], ["--dry-run"]):
            assert main(["bench", "run", suite, "-o", str(results), *words, *more]) == 1
            assert told in capsys.readouterr().err
    assert not results.exists()


def test_results_of_another_protocol_are_not_added_to(finished, tmp_path, capsys):
    content, _, results = finished
    longer = {**content, "protocol": {**content["protocol"], "iterations": 13}}
    words = ["bench", "run", write_suite(longer, tmp_path), "--only", "scene=tiny", "-o", str(results)]
    before = sorted(results.rglob("*"))
    for more in ([], ["--dry-run"]):
        assert main([*words, *more]) == 1
        assert "protocol.iterations is 12 there and 13 here" in capsys.readouterr().err
    assert sorted(results.rglob("*")) == before


def test_scenes_and_methods_that_have_rows_stay_as_they_are(content, tmp_path, monkeypatch, capsys):
    """Where they lie may change; what is new may be added; the axes may be extended."""
    for folder in ("taming", "moved"):
        (tmp_path / folder).mkdir()
    content["protocol"].update(device="cuda", principal_point="centre")
    scene, = content["scenes"]
    method = {"name": "taming", "path": "taming", "arguments": ["--cams", 10]}
    content["methods"] = [method]
    cell = expand(content, str(tmp_path)).cells[0]
    (tmp_path / "rows.jsonl").write_text(done_row(cell) + "\n")
    words = ["bench", "run", write_suite(content, tmp_path), "-o", str(tmp_path / "results"), "--only",
             "blend_mode=alpha"]
    assert main([*words, "--rows", str(tmp_path / "rows.jsonl")]) == 0

    def said(**changes):
        write_suite({**content, **changes}, tmp_path)
        status = main([*words, "--dry-run"])
        told = capsys.readouterr()
        assert status == (1 if told.err else 0)
        return told.err or told.out

    for field, here, there in (("resolution", 2, -1), ("background", "white", "black"), ("images", "others", "images"),
                               ("dataset", "Other", None)):
        told = said(scenes=[{**scene, field: here}])
        assert f"scene tiny: {field} is {there!r} there and {here!r} here" in told and "another folder with -o" in told
    assert "scene tiny: synthetic is None there and {'views': 3} here" in said(
        scenes=[{"name": "tiny", "synthetic": {"views": 3}}])
    assert "method taming: arguments is ['--cams', '10'] there and ['--cams', '20'] here" in said(
        methods=[{**method, "arguments": ["--cams", 20]}])
    assert said(methods=[{**method, "path": "moved"}]).endswith("1 done, 0 to do, 0 failed\n")
    assert said(scenes=[scene, {**scene, "name": "new", "resolution": 2}],
                methods=[method, {"name": "native"}], seeds=[0, 1]).endswith("1 done, 7 to do, 0 failed\n")


def test_checkouts_that_are_not_there_are_named_before_anything_is_run(content, tmp_path, capsys):
    (tmp_path / "there").mkdir()
    content["protocol"].update(device="cuda", principal_point="centre")
    content["methods"] += [{"name": "taming", "path": "nowhere"},
                           {"name": "2dgs", "label": "other", "path": "there"},  # that is enough beforehand
                           {"name": "c3dgs", "path": "there", "base": "neither"}]
    words = ["bench", "run", write_suite(content, tmp_path), "-o", str(tmp_path / "results")]
    lines = [f"method taming: path: {tmp_path / 'nowhere'}: no such folder, where a checkout of taming must be; "
             "name it",
             f"method c3dgs: base: {tmp_path / 'neither'}: no such folder, where the 3DGS checkout must be that "
             "trains what c3dgs compresses; name it"]
    assert main([*words, "--dry-run"]) == 0
    assert capsys.readouterr().out.splitlines()[7:] == [*lines, "0 done, 7 to do, 0 failed"]
    assert main([*words, "--dry-run", "--only", "method=native"]) == 0
    assert "no such folder" not in capsys.readouterr().out
    for line, only in ((lines[0], []), (lines[1], ["--only", "method=c3dgs"])):
        assert main([*words, *only]) == 1
        assert f"{line}, or leave it out with --only" in capsys.readouterr().err
    assert not (tmp_path / "results").exists()


@pytest.fixture
def running(content, tmp_path):
    """A run in the middle of its only cell: the suite, the results, the process, the cell's folder."""
    content["protocol"].update(iterations=500, checkpoint_every=20, evaluate_every=0)
    content["protocol"]["options"] = {"densify_until_iter": 0}
    content["blend_modes"] = ["alpha"]
    suite, results = write_suite(content, tmp_path), tmp_path / "results"
    run = subprocess.Popen(command("bench", "run", suite, "-o", str(results)), env=environment(), cwd=str(tmp_path),
                           start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                           # Shells start what they put in the background deaf to it.
                           preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    wait_for(lambda: list(results.glob("cells/*/run/checkpoint.pt")), 120)
    folder, = results.glob("cells/*")
    yield suite, results, run, folder
    run.stderr.close()


@pytest.mark.slow
def test_a_killed_run_continues_where_it_was(running):
    """Killed without warning in the middle of a cell, all of it: it goes on from its checkpoint."""
    suite, results, run, folder = running
    os.killpg(run.pid, signal.SIGKILL)
    run.wait()
    assert not (folder / "row.json").exists()
    wait_for(lambda: is_free(results), 60)
    assert main(["bench", "run", suite, "-o", str(results)]) == 0
    row, = rows_of(results).values()
    assert row["ok"] and row["protocol"]["continued"]
    assert "resumed at iteration" in (folder / "log.txt").read_text()


@pytest.mark.parametrize("number", [pytest.param(signal.SIGKILL, marks=pytest.mark.slow), signal.SIGTERM,
                                    pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_what_a_run_has_started_ends_with_it_and_keeps_others_away_till_then(number, running, capsys):
    suite, results, run, folder = running
    inner = int(processes_with(f"cells/{folder.name} --inside")[0].parent.name)
    os.kill(inner, signal.SIGSTOP)  # it cannot end until it goes on
    assert main(["bench", "run", suite, "-o", str(results)]) == 1
    os.kill(run.pid, number)
    assert run.wait(timeout=60) == {signal.SIGKILL: -9, signal.SIGTERM: 143, signal.SIGINT: 130}[number]
    wait_for(lambda: not processes_with(str(results)), 60)  # Snakemake
    assert main(["bench", "run", suite, "-o", str(results)]) == 1
    assert capsys.readouterr().err.count("another run is at work there") == 2
    os.kill(inner, signal.SIGCONT)
    wait_for(lambda: is_free(results) and not processes_with(f"cells/{folder.name}"), 60)
    assert not (folder / "row.json").exists()
    told = run.stderr.read().decode()
    assert "Traceback" not in told
    if number == signal.SIGINT:
        assert "interrupted; the same command continues" in told
    if number != signal.SIGKILL:
        assert (results / "rows.jsonl").read_text() == ""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_what_is_queued_is_cancelled_at_leisure(number, tmp_path):
    """Whatever ends the command, and where a terminal tells all that it has started. Snakemake is another program here:
    it is interrupted once, cancels for a second, and a second signal would end it."""
    told = tmp_path / "told"
    snakemake = tmp_path / "snakemake.py"
    snakemake.write_text(
        "import signal, time\n"
        "def cancel(*_):\n"
        "    signal.signal(signal.SIGINT, signal.SIG_DFL)\n"
        "    time.sleep(1)\n"
        f"    open({str(told)!r}, 'a').write('cancelled')\n"
        "    raise SystemExit(1)\n"
        "signal.signal(signal.SIGINT, cancel)\n"
        f"open({str(told)!r}, 'w').write('running ')\n"
        "time.sleep(60)\n")
    program = ("import sys\nfrom diff_smoe_rasterization.benchmarks.suite import engine\n"
               f"with engine.only_one({str(tmp_path)!r}) as lock:\n"
               f"    engine.run_snakemake([sys.executable, {str(snakemake)!r}], lock, is_queued=True)\n")
    run = subprocess.Popen([sys.executable, "-c", program], env=environment(), cwd=str(tmp_path),
                           start_new_session=True, stderr=subprocess.DEVNULL,
                           preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    wait_for(lambda: run.poll() is not None or (told.exists() and told.read_text() == "running "), 60)
    assert run.poll() is None
    os.killpg(run.pid, number)
    wait_for(lambda: told.read_text() == "running cancelled", 30)
    run.wait(timeout=30)


def is_free(results):
    try:
        with engine.only_one(str(results)):
            return True
    except TrainerError:
        return False


def processes_with(words):
    """The processes whose command line has these words (Linux)."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            found += [path] if words in path.read_text(errors="replace").replace("\0", " ") else []
        except OSError:  # it has ended meanwhile
            pass
    return found


def test_cells_are_chosen_by_their_fields(content):
    suite = expand({**content, "seeds": [0, 1], "headline": {"seeds": [1]}}, "")
    found = selection.chosen(suite.cells, ["blend_mode=smoe", "seed=0", "seed=1", "densify_grad_threshold=5e-3"])
    assert [(cell["blend_mode"], cell["seed"]) for cell in found] == [("smoe", 0), ("smoe", 1)]
    assert len(selection.chosen(suite.cells, ["headline=true"])) == 2
    gates = expand({**content, "background_gates": [0, 0.05, "learned"]}, "").cells
    for text, blend in (("5e-2", "smoe 0.05"), ("0", "smoe"), ("1", "alpha"), ("learned", "smoe learned")):
        assert [blend_of(cell) for cell in selection.chosen(gates, ["background_gate=" + text])] == [blend]
    with pytest.raises(BenchError, match="--only blend_mode=smoe_std: .* alpha, smoe"):
        selection.chosen(suite.cells, ["blend_mode=smoe_std"])
    for wrong in ("blend_mode", "mode=alpha"):
        with pytest.raises(BenchError, match="--only " + wrong):
            selection.chosen(suite.cells, [wrong])


def test_gpus_and_queues_are_snakemakes_business(content, monkeypatch):
    content["protocol"].update(device="cuda", principal_point="centre")
    suite = expand({**content, "headline": {"blend_modes": ["smoe"]}, "seeds": list(range(8))}, "")
    headline = [f"cells/{cell['id']}/row.json" for cell in suite.cells if cell["blend_mode"] == "smoe"]
    monkeypatch.setattr(engine, "threads_of_each", lambda at_once: 24 // at_once)
    with monkeypatch.context() as patch:
        patch.setattr(engine, "visible_gpus", lambda: ["0", "2", "3"])
        words = engine.command(suite, suite.cells, "out", None, None)
        assert words[words.index("--cores") + 1] == "24" and "gpu=3" in words and 'gpus=["0", "2", "3"]' in words
        assert words[words.index("--prioritize") + 1:] == headline
        assert "--executor" not in words and "per_device=1" in words and "threads=8" in words
        words = engine.command(suite, suite.cells, "out", None, None, per_gpu=4)
        assert words[words.index("--cores") + 1] == "24" and "gpu=12" in words and "per_device=4" in words
        words = engine.command(suite, suite.cells, "out", 5, None, per_gpu=4)
        # Five cells on three GPUs: two share one at the most. So it is where only five are to be run.
        assert words[words.index("--cores") + 1] == "20" and "gpu=6" in words and "per_device=2" in words
        assert "per_device=2" in engine.command(suite, suite.cells[:5], "out", None, None, per_gpu=4)
        words = engine.command(suite, suite.cells, "out", 3, None, per_gpu=2)
        assert "gpu=3" in words and "per_device=1" in words
        with pytest.raises(BenchError, match="--per-gpu is 0"):
            engine.check_sharing(suite, None, None, per_gpu=0)
        with pytest.raises(BenchError, match="--per-gpu is 2; it is for"):
            engine.check_sharing(suite, None, ["slurm_partition=gpu"], per_gpu=2)
        patch.setattr(engine, "visible_gpus", list)
        with pytest.raises(BenchError, match="no CUDA device"):
            engine.command(suite, suite.cells, "out", None, None)
        patch.setattr(engine.importlib.util, "find_spec", lambda name: object())
        words = engine.command(suite, suite.cells, "out", None, ["slurm_partition=gpu", "runtime=60"])
        assert words[words.index("--executor") + 1] == "slurm" and "gpus=[]" in words
        assert "per_device=0" in words and "threads=1" in words
        assert words[words.index("--default-resources") + 1:][:3] == ["slurm_partition=gpu", "runtime=60", "mem_mb=0"]
        words = engine.command(suite, suite.cells, "out", None, ["mem_mb_per_cpu=2000"])
        assert words[words.index("--default-resources") + 1:][:2] == ["mem_mb_per_cpu=2000", "--prioritize"]
        assert "threads=8" in engine.command(suite, suite.cells, "out", None, ["runtime=60", "cpus_per_task=8"])
        for number in ("0", "-2", "all", "", "\u0663"):
            with pytest.raises(BenchError, match=f"cpus_per_task={number}: must be a number of at least 1"):
                engine.command(suite, suite.cells, "out", None, [f"cpus_per_task={number}"])
        patch.setattr(engine.importlib.util, "find_spec", lambda name: None if "slurm" in name else object())
        with pytest.raises(BenchError, match="snakemake-executor-plugin-slurm"):
            engine.command(suite, suite.cells, "out", None, [])


def test_on_the_cpu_cells_share_its_cores(content, monkeypatch):
    """As many threads as torch takes, if there are cores for them: 10 cores here, where torch takes 8."""
    suite = expand({**content, "seeds": [0, 1]}, "")
    monkeypatch.setattr(torch, "get_num_threads", lambda: 8)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: range(10), raising=False)
    for jobs, count, at_once, threads in ((None, 4, 1, 8), (1, 4, 1, 8), (3, 4, 3, 3), (16, 4, 4, 2), (16, 1, 1, 8)):
        words = engine.command(suite, suite.cells[:count], "out", jobs, None)
        assert f"per_device={at_once}" in words and f"threads={threads}" in words
        assert words[words.index("--cores") + 1] == str(at_once * threads)
    assert engine.threads_of_each(11) == 1


CELL_PYTHON = """#!/bin/sh
case "$*" in *snakemake*) exec "{python}" "$@" ;; esac
cp "../${{4#cells/}}.json" "$4/row.json"
echo "$OMP_NUM_THREADS threads: $*" >>told
"""


def test_cells_are_told_the_gpus_and_their_threads(content, tmp_path, monkeypatch):
    """One GPU, called 0, which Snakemake would take for a number; another program stands for the cells' Python."""
    content["protocol"].update(device="cuda", principal_point="centre")
    for cell in expand(content, "").cells:
        (tmp_path / f"{cell['id']}.json").write_text(done_row(cell))
    python = tmp_path / "python"
    python.write_text(CELL_PYTHON.format(python=sys.executable))
    python.chmod(0o755)
    monkeypatch.setattr(engine, "visible_gpus", lambda: ["0"])
    monkeypatch.setattr(engine.sys, "executable", str(python))
    monkeypatch.setattr(engine, "threads_of_each", lambda at_once: 6 // at_once)
    words = ["bench", "run", write_suite(content, tmp_path), "-o", str(tmp_path / "results"), "--per-gpu", "2"]
    assert main(words) == 0
    told = (tmp_path / "results" / "told").read_text().splitlines()
    assert len(told) == 2
    for line in told:
        assert line.startswith("3 threads: ") and line.endswith(" --gpus 0 --locks .locks --per-device 2")
