"""From a suite to rows: what is done is not done again, what fails is a row, what is killed continues."""
import contextlib
import csv
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from bench_commands import COMMAND, python_that, rows_of, tiny_suite, wait_for
from checkouts import environment

from dsmoe.bench import engine
from dsmoe.bench.cell import failed_row
from dsmoe.bench.errors import BenchError
from dsmoe.bench.expansion import expand
from dsmoe.bench.names import blend_of
from dsmoe.cli import main
from dsmoe.errors import TrainerError
from dsmoe.system.output_folder import Record, write_record

pytest.importorskip("snakemake", reason="the engine is Snakemake: pip install snakemake")


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
    write_record(str(folder / "results"), engine.COMMAND, Record("two", []), [])  # else the folder is refused
    content = {**tiny_suite(tiny_scene), "name": "two", "blend_modes": ["smoe"], "images": 1}
    content["scenes"].append({"name": "absent", "path": str(folder / "nothing")})
    suite = write_suite(content, folder)
    assert main(["bench", "run", suite, "-o", str(folder / "results"), "--jobs", "2"]) == 1
    return content, suite, folder / "results"


def test_a_figure_of_the_paper_by_its_name_on_scenes_at_hand(tiny_scene, tmp_path):
    (tmp_path / "scenes.yaml").write_text(yaml.safe_dump([{"name": "tiny", "path": str(tiny_scene)}]))
    only = [word for field in ("method=native", "blend_mode=paper", "densify_grad_threshold=0.005")
            for word in ("--only", field)]
    assert main(["bench", "run", "fig5", "-o", str(tmp_path / "results"), "--scenes", str(tmp_path / "scenes.yaml"),
                 "--device", "cpu", "--iterations", "12", *only]) == 0
    row, = rows_of(tmp_path / "results").values()
    assert (row["suite"], row["scene"], row["blend_mode"], row["iterations"]) == ("fig5", "tiny", "smoe", 12)
    assert row["background_gate"] == 0 and row["faint_below"] == row["protocol"]["faint_below"] == 2


@pytest.fixture
def copied(finished, tmp_path):
    return Path(shutil.copytree(finished[2], tmp_path / "results"))


def test_a_row_says_what_was_measured_and_how(finished):
    row, = [row for row in rows_of(finished[2]).values() if row["ok"]]
    assert all(row[name] > 0 for name in ("psnr", "psnr_float", "ssim", "psnr_edge", "train_seconds", "fps"))
    assert (row["method"], row["variant"], row["blend_mode"], row["strategy"]) == ("native", "native", "smoe", "3dgs")
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
    assert main(["bench", "report", str(finished[2]), "-o", str(tmp_path)]) == 0
    row = {row["ok"]: row for row in rows_of(finished[2]).values()}
    cells, failures = (list(csv.DictReader((tmp_path / "tables" / f"two_{name}.csv").read_text("utf-8").splitlines()))
                       for name in ("cells", "failures"))
    measured, = (line for line in cells if line["scene"] == "tiny")
    assert float(measured["PSNR [dB]"]) == row[True]["psnr"]
    assert int(measured["#Gaussians"]) == row[True]["num_gaussians"]
    assert [(line["cell"], line["reason"]) for line in failures] == [(row[False]["cell"], row[False]["reason"])]
    assert "2 cells on 2 scenes, 1 seed; 1 failed" in (tmp_path / "index.html").read_text(encoding="utf-8")
    assert len(list((tmp_path / "images").rglob("*.png"))) == 3  # the truth, a rendering, its error


@pytest.fixture
def bench(capsys):
    """From a suite, a folder and words of `dsmoe bench run` to its status and what it printed."""
    def call(suite, results, *words):
        capsys.readouterr()
        status = main(["bench", "run", suite, "-o", str(results), *words])
        told = capsys.readouterr()
        return status, told.out + told.err
    return call


@pytest.mark.slow
def test_a_failed_cell_is_tried_again_where_that_is_asked_for(copied, finished, tmp_path):
    """The reason is gone, and only the cell that failed is run."""
    there, absent = finished[0]["scenes"]
    suite = write_suite({**finished[0], "scenes": [there, {**absent, "path": there["path"]}]}, tmp_path)
    logs = {path.parent.name: path.read_text() for path in copied.glob("cells/*/log.txt")}
    assert main(["bench", "run", suite, "-o", str(copied), "--retry-failed"]) == 0
    rows = rows_of(copied)
    assert set(rows) == set(logs) and all(row["ok"] for row in rows.values())
    changed = {name for name in logs if (copied / "cells" / name / "log.txt").read_text() != logs[name]}
    assert changed == {name for name, row in rows.items() if row["scene"] == "absent"}


def test_what_is_done_is_not_done_again_here_and_elsewhere(finished, tmp_path, bench):
    content, suite, results = finished
    *lines, summary = bench(suite, results, "--dry-run")[1].splitlines()
    assert [line.split()[0] for line in lines] == ["done", "failed"] and summary == "1 done, 0 to do, 1 failed"
    rows, new = ["--rows", str(results / "rows.jsonl")], tmp_path / "new"
    assert bench(suite, new, "--dry-run", *rows)[1].splitlines()[0] == f"2 of 2 cells taken from {rows[1]}"
    counted, *lines, summary = bench(suite, new, "--dry-run", "--retry-failed", *rows)[1].splitlines()
    assert counted.startswith("1 of 2 cells") and [line.split()[0] for line in lines] == ["done", "to"]
    assert summary == "1 done, 1 to do, 0 failed"
    longer = write_suite({**content, "protocol": {**content["protocol"], "iterations": 13}}, tmp_path)
    assert "none of its 2 rows is of a cell" in bench(longer, new, *rows)[1]
    assert "absent.jsonl" in bench(suite, new, "--rows", str(tmp_path / "absent.jsonl"))[1]
    assert not new.exists()
    assert bench(suite, new, *rows)[0] == 1  # one failed
    assert rows_of(new) == rows_of(results) and not list(new.glob("cells/*/log.txt"))
    other = write_suite({**content, "name": "other"}, tmp_path)
    assert bench(other, tmp_path / "other", *rows)[0] == 1
    assert {row["suite"] for row in rows_of(tmp_path / "other").values()} == {"other"}


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


@pytest.mark.parametrize("mine", ["scenes/tiny/photo.jpg", "suite.json", "cells/notes"])
def test_a_folder_with_something_else_is_refused(finished, tmp_path, bench, mine):
    (tmp_path / "results" / mine).parent.mkdir(parents=True)
    (tmp_path / "results" / mine).write_text("mine")
    status, told = bench(write_suite(finished[0], tmp_path), tmp_path / "results")
    assert status == 1 and "is not empty" in told and "nothing says that dsmoe bench run wrote it" in told
    files = [path for path in (tmp_path / "results").rglob("*") if path.is_file()]
    assert files == [tmp_path / "results" / mine] and files[0].read_text() == "mine"


def done_row(cell):
    """A line that says that a cell worked."""
    return json.dumps({**failed_row(cell, "", 1.0), "ok": True, "psnr": 20.0, "num_gaussians": 5})


@pytest.mark.parametrize("damaged", ["{}", "[]", '{"ok": true}', "", "another cell's"])
def test_a_damaged_row_is_named_before_anything_is_run(damaged, copied, finished, bench):
    one, other = sorted(copied.glob("cells/*/row.json"))
    one.write_text(other.read_text() if damaged == "another cell's" else damaged)
    for more in ([], ["--dry-run"], ["--only", f"scene={json.loads(other.read_text())['scene']}"]):
        status, told = bench(finished[1], copied, *more)
        assert status == 1 and f"error: {one}: " in told and "remove it to have it made anew" in told
    one.unlink()
    assert "1 to do" in bench(finished[1], copied, "--dry-run")[1]


@pytest.mark.parametrize("words, told", [
    (["--jobs", "0"], "--jobs is 0"), (["--per-gpu", "-1"], "--per-gpu is -1"),
    (["--per-gpu", "2"], "protocol.device cuda"), (["--per-gpu", "2", "--slurm"], "without --slurm"),
    (["--slurm", "gpu"], "--slurm gpu: must be KEY=VALUE"), (["--slurm", "=gpu"], "--slurm =gpu: must be KEY=VALUE"),
    (["--only", "blend_mode=smoe_std"], "--only blend_mode=smoe_std: no cell of the suite is so; its cells have alpha"),
    (["--only", "blend_mode"], "--only blend_mode: must be"), (["--only", "mode=alpha"], "--only mode=alpha: must be")])
def test_options_that_do_not_go_together_are_refused_before_anything_is_written(words, told, content, tmp_path, bench):
    for more in ([], ["--dry-run"]):
        status, said = bench(write_suite(content, tmp_path), tmp_path / "results", *words, *more)
        assert status == 1 and told in said
    assert not (tmp_path / "results").exists()


def test_scenes_and_methods_that_have_rows_stay_as_they_are(content, tmp_path, bench):
    """Where they lie may change; what is new may be added; the axes may be extended."""
    for folder in ("taming", "moved"):
        (tmp_path / folder).mkdir()
    content["protocol"].update(device="cuda", principal_point="centre")
    scene, = content["scenes"]
    method = {"name": "taming", "path": "taming", "arguments": ["--cams", 10]}
    content["methods"] = [method]
    (tmp_path / "rows.jsonl").write_text(done_row(expand(content, str(tmp_path)).cells[0]) + "\n")
    results, alpha = tmp_path / "results", ["--only", "blend_mode=alpha"]
    assert bench(write_suite(content, tmp_path), results, "--rows", str(tmp_path / "rows.jsonl"), *alpha)[0] == 0

    def said(**changes):
        return bench(write_suite({**content, **changes}, tmp_path), results, "--dry-run", *alpha)[1]

    longer = {"protocol": {**content["protocol"], "iterations": 13}}
    for changes, told in ((longer, "protocol.iterations is 12 there and 13 here"),
                          ({"scenes": [{**scene, "resolution": 2}]}, "scene tiny: resolution is -1 there and 2 here"),
                          ({"scenes": [{**scene, "dataset": "X"}]}, "scene tiny: dataset is None there and 'X' here"),
                          ({"scenes": [{"name": "tiny", "synthetic": {"views": 3}}]}, "scene tiny: synthetic is None"),
                          ({"methods": [{**method, "arguments": ["--cams", 20]}]},
                           "method taming: arguments is ['--cams', '10'] there and ['--cams', '20'] here")):
        assert told in said(**changes) and "Choose another folder with -o" in said(**changes)
    assert said(methods=[{**method, "path": "moved"}]).endswith("1 done, 0 to do, 0 failed\n")
    assert said(scenes=[scene, {**scene, "name": "new", "resolution": 2}],
                methods=[method, {"name": "native"}], seeds=[0, 1]).endswith("1 done, 7 to do, 0 failed\n")


def test_checkouts_that_are_not_there_are_told_and_left_out(content, tmp_path, bench):
    """Before anything is run. That no method is there is an error."""
    (tmp_path / "there").mkdir()
    content["protocol"].update(device="cuda", principal_point="centre")
    content["methods"] += [{"name": "taming", "path": "nowhere"},
                           {"name": "2dgs", "label": "other", "path": "there"},  # that is enough beforehand
                           {"name": "c3dgs", "path": "there", "base": "neither"}]
    run = write_suite(content, tmp_path), tmp_path / "results"
    lines = [f"{what}: {tmp_path / folder}: no such folder, where {wanted}; name it" for what, folder, wanted in (
        ("method taming: path", "nowhere", "a checkout of taming must be"),
        ("method c3dgs: base", "neither", "the 3DGS checkout must be that trains what c3dgs compresses"))]
    told = [f"left out: {line}" for line in reversed(lines)]
    assert bench(*run, "--dry-run")[1].splitlines()[3:] == [*told, "0 done, 3 to do, 0 failed"]
    assert "no such folder" not in bench(*run, "--dry-run", "--only", "method=native")[1]
    for more in ([], ["--dry-run"]):
        status, words = bench(*run, "--only", "method=c3dgs", *more)
        assert status == 1 and f"error: {lines[1]}, or leave it out with --only" in words
    assert not (tmp_path / "results").exists()


def started(words, folder, **pipes):
    """A process in a session of its own, to which SIGINT is a signal as it is to one in a terminal's foreground."""
    return subprocess.Popen(words, env=environment(), cwd=str(folder), start_new_session=True,
                            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), **pipes)


@pytest.fixture
def running(content, tmp_path):
    """A run in the middle of its only cell: the suite, the results, the process, the cell's folder."""
    content["protocol"].update(iterations=500, checkpoint_every=20, evaluate_every=0)
    content["protocol"]["options"] = {"densify_until_iter": 0}
    suite, results = write_suite({**content, "blend_modes": ["alpha"]}, tmp_path), tmp_path / "results"
    run = started([*COMMAND, "run", suite, "-o", str(results)], tmp_path, stdout=subprocess.DEVNULL,
                  stderr=subprocess.PIPE)
    wait_for(lambda: list(results.glob("cells/*/run/checkpoint.pt")), 120)
    folder, = results.glob("cells/*")
    yield suite, results, run, folder
    run.stderr.close()


@pytest.mark.parametrize("number", [pytest.param(signal.SIGKILL, marks=pytest.mark.slow), signal.SIGTERM,
                                    pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_what_a_run_has_started_ends_with_it_keeps_others_away_till_then_and_continues(number, running, capsys):
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
    else:  # once is enough
        assert main(["bench", "run", suite, "-o", str(results)]) == 0
        row, = rows_of(results).values()
        assert row["ok"] and row["protocol"]["continued"]
        assert "resumed at iteration" in (folder / "log.txt").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_what_is_queued_is_cancelled_at_leisure(number, tmp_path):
    """Whatever ends the command, and where a terminal tells all that it has started. Snakemake is another program here:
    it is interrupted once, cancels for a second, and a second signal would end it."""
    told, snakemake = tmp_path / "told", tmp_path / "snakemake"
    snakemake.write_text("trap 'trap - INT; sleep 1; echo cancelled >>told; kill $!; exit 1' INT\n"
                         "echo running >told\nsleep 60 &\nwait\n")
    program = ("from dsmoe.bench import engine\n"
               "with engine.only_one('.') as lock:\n"
               "    engine.run_snakemake(['sh', 'snakemake'], lock, is_queued=True)\n")
    run = started([sys.executable, "-c", program], tmp_path, stderr=subprocess.DEVNULL)
    wait_for(lambda: run.poll() is not None or (told.exists() and told.read_text() == "running\n"), 60)
    assert run.poll() is None
    os.killpg(run.pid, number)
    wait_for(lambda: told.read_text() == "running\ncancelled\n", 30)
    run.wait(timeout=30)


def is_free(results):
    with contextlib.suppress(TrainerError), engine.only_one(str(results)):
        return True


def processes_with(words):
    """The processes whose command line has these words (Linux)."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            found += [path] if words in path.read_text(errors="replace").replace("\0", " ") else []
    return found


def test_cells_are_chosen_by_their_fields(content):
    cells = expand({**content, "seeds": [0, 1], "headline": {"seeds": [1]}, "background_gates": [0, 0.05, "learned"]},
                   "").cells
    for words, found in ((["blend_mode=alpha", "seed=0", "seed=1", "densify_grad_threshold=5e-3"], {"alpha"}),
                         (["headline=true"], {"alpha", "smoe", "smoe 0.05", "smoe learned"}),
                         (["background_gate=5e-2"], {"smoe 0.05"}), (["background_gate=0"], {"smoe"}),
                         (["background_gate=1"], {"alpha"}), (["background_gate=learned"], {"smoe learned"})):
        chosen = engine.chosen(cells, words)
        assert {blend_of(cell) for cell in chosen} == found
        assert {cell["seed"] for cell in chosen} == ({1} if words == ["headline=true"] else {0, 1})


def words_of(suite, *arguments, **more):
    """{flag or name: what follows it} of Snakemake's command line."""
    words = engine.command(suite, suite.cells, "out", *arguments, **more)
    found = dict(zip(words, words[1:]))
    return {**found, **dict(word.split("=", 1) for word in words if "=" in word), "all": words}


# Cells at once, per GPU: 8 threads each, on 24 cores. Five cells on three GPUs: two share one at the most.
@pytest.mark.parametrize("jobs, per_gpu, cells, cores, gpu, per_device", [
    (None, 1, 16, 24, 3, 1), (None, 4, 16, 24, 12, 4), (5, 4, 16, 20, 6, 2), (None, 4, 5, 20, 6, 2),
    (3, 2, 16, 24, 3, 1)])
def test_cells_are_spread_over_gpus(jobs, per_gpu, cells, cores, gpu, per_device, on_gpus):
    suite = dataclasses.replace(on_gpus, cells=on_gpus.cells[:cells])
    words = words_of(suite, jobs, None, per_gpu=per_gpu)
    assert (words["--cores"], words["gpu"], words["per_device"]) == (str(cores), str(gpu), str(per_device))
    assert words["gpus"] == '["0", "2", "3"]' and "--executor" not in words
    headline = [f"cells/{cell['id']}/row.json" for cell in suite.cells if cell["headline"]]
    assert words["all"][-len(headline) - 1:] == ["--prioritize", *headline]


@pytest.fixture
def on_gpus(content, monkeypatch):
    """A suite of 16 cells for GPUs; three GPUs are visible."""
    content["protocol"].update(device="cuda", principal_point="centre")
    monkeypatch.setattr(engine, "threads_of_each", lambda at_once: 24 // at_once)
    monkeypatch.setattr(engine, "visible_gpus", lambda: ["0", "2", "3"])
    return expand({**content, "headline": {"blend_modes": ["alpha"]}, "seeds": list(range(8))}, "")


def test_cells_of_two_gpus_take_two_of_three(on_gpus, monkeypatch):
    monkeypatch.setattr(engine.importlib.util, "find_spec", lambda name: object())  # of Slurm's plugin
    on_gpus.protocol["gpus"] = 2
    words = words_of(on_gpus, None, None)
    assert (words["gpus_each"], words["gpu"], words["--cores"]) == ("2", "3", "24")  # one cell at once
    assert words_of(on_gpus, None, ["runtime=10"])["gpus_each"] == "2"
    with pytest.raises(BenchError, match="--per-gpu is 2; it must be 1 with protocol.gpus 2"):
        engine.check_sharing(on_gpus, None, None, 2)
    on_gpus.protocol["gpus"] = 4
    with pytest.raises(BenchError, match="protocol.gpus is 4, and torch finds 3 on this machine"):
        words_of(on_gpus, None, None)


def test_queues_are_snakemakes_business(on_gpus, monkeypatch):
    monkeypatch.setattr(engine, "visible_gpus", list)
    with pytest.raises(BenchError, match="no CUDA device"):
        engine.command(on_gpus, on_gpus.cells, "out", None, None)
    monkeypatch.setattr(engine.importlib.util, "find_spec", lambda name: None if "slurm" in name else object())
    with pytest.raises(BenchError, match="snakemake-executor-plugin-slurm"):
        engine.command(on_gpus, on_gpus.cells, "out", None, [])
    monkeypatch.setattr(engine.importlib.util, "find_spec", lambda name: object())
    for asked, threads, resources in ((["runtime=60"], "1", ["runtime=60", "mem_mb=0"]),
                                      (["mem_mb_per_cpu=2"], "1", ["mem_mb_per_cpu=2", "--prioritize"]),
                                      (["mem=2", "cpus_per_task=8"], "8", ["mem=2", "cpus_per_task=8"])):
        words = words_of(on_gpus, None, asked)
        assert (words["--executor"], words["gpus"], words["per_device"]) == ("slurm", "[]", "0")
        assert words["threads"] == threads
        assert words["all"][words["all"].index("--default-resources") + 1:][:2] == resources
    for number in ("0", "-2", "all", "", "\u0663"):
        with pytest.raises(BenchError, match=f"cpus_per_task={number}: must be a number of at least 1"):
            words_of(on_gpus, None, [f"cpus_per_task={number}"])


@pytest.mark.parametrize("jobs, count, at_once, threads", [
    (None, 4, 1, 8), (1, 4, 1, 8), (3, 4, 3, 3), (16, 4, 4, 2), (16, 1, 1, 8)])
def test_on_the_cpu_cells_share_its_cores(jobs, count, at_once, threads, content, monkeypatch):
    """As many threads as torch takes, if there are cores for them: 10 cores here, of which torch takes 8."""
    suite = expand({**content, "seeds": [0, 1]}, "")
    monkeypatch.setattr(torch, "get_num_threads", lambda: 8)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: range(10), raising=False)
    words = words_of(dataclasses.replace(suite, cells=suite.cells[:count]), jobs, None)
    assert (words["per_device"], words["threads"], words["--cores"]) == tuple(map(str, (
        at_once, threads, at_once * threads)))


def test_cells_are_told_the_gpus_and_their_threads(content, tmp_path, monkeypatch):
    """One GPU, called 0, which Snakemake would take for a number. The cells' Python writes down its words and fails."""
    content["protocol"].update(device="cuda", principal_point="centre")
    python = python_that(f'case "$*" in *snakemake*) exec "{sys.executable}" "$@" ;; esac\n'
                         'echo "$OMP_NUM_THREADS threads: $*" >>told\nexit 1\n', tmp_path)
    monkeypatch.setattr(engine, "visible_gpus", lambda: ["0"])
    monkeypatch.setattr(engine.sys, "executable", python)
    monkeypatch.setattr(engine, "threads_of_each", lambda at_once: 6 // at_once)
    words = ["bench", "run", write_suite(content, tmp_path), "-o", str(tmp_path / "results"), "--per-gpu", "2"]
    assert main(words) == 1
    told = (tmp_path / "results" / "told").read_text().splitlines()
    assert len(told) == 2
    for line in told:
        assert line.startswith("3 threads: ") and line.endswith(" --gpus 0 --locks .locks --per-device 2")


@pytest.mark.slow  # a minute
def test_the_suite_smoke(tmp_path):
    """From end to end, as a user types it."""
    for words in (["run", "smoke", "-o", "results"], ["report", "results", "-o", "report"]):
        subprocess.run([*COMMAND, *words], env=environment(), cwd=str(tmp_path), check=True)
    rows = rows_of(tmp_path / "results").values()
    for row in rows:
        halfway, = row["history"]
        assert row["ok"] and halfway["iteration"] == 150 and row["psnr"] > halfway["psnr"]
    assert len(rows) == 4 and (tmp_path / "report" / "tables" / "smoke_cells.csv").is_file()
