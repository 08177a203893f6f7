"""The shipped suite `smoke` from end to end, as a user types it: run, then report."""
from __future__ import annotations

import csv
import math
import subprocess

import pytest
from bench_commands import command, environment, rows_of

for library in ("yaml", "snakemake", "matplotlib", "jinja2"):
    pytest.importorskip(library, reason="`dsmoe bench` needs it: pip install '.[bench]', with Python 3.11 or later")
from diff_smoe_rasterization.benchmarks.suite.expansion import find_suite, load_suite  # noqa: E402

pytestmark = pytest.mark.slow  # a minute; test_engine.py goes from a smaller suite to its report


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("smoke")
    call("bench", "run", "smoke", "-o", "results", cwd=folder)  # one cell after another: their times are their own
    call("bench", "report", "results", "-o", "report", cwd=folder)
    return folder


def call(*words, cwd):
    """Fails with all that the command said."""
    done = subprocess.run(command(*words), env=environment(), cwd=str(cwd), stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT)
    assert done.returncode == 0, done.stdout.decode(errors="replace")


def test_every_cell_has_a_row_with_figures(results):
    rows = rows_of(results / "results")
    assert set(rows) == {cell["id"] for cell in load_suite(find_suite("smoke")).cells} and len(rows) == 4
    assert {name: row["reason"] for name, row in rows.items() if not row["ok"]} == {}
    for row in rows.values():
        figures = [row[name] for name in ("psnr", "psnr_float", "psnr_edge", "ssim", "train_seconds", "wall_seconds",
                                          "fps", "num_gaussians")]
        assert all(math.isfinite(figure) and figure > 0 for figure in figures), row["cell"]
        assert row["machine"]["cells_at_once"] == 1
        halfway, = row["history"]
        assert halfway["iteration"] == 150 and row["psnr"] > halfway["psnr"]


def test_the_report_has_its_page_tables_and_figures(results):
    report = results / "report"
    assert {path.name for path in (report / "tables").iterdir()} == {
        f"smoke_{name}.{form}" for name in ("cells", "deltas") for form in ("md", "csv", "tex")}
    assert {path.name for path in (report / "figures").iterdir()} == {
        f"smoke-room-{kind}{end}" for kind in ("rd", "time") for end in (".png", "-light.svg", "-dark.svg")}
    page = (report / "index.html").read_text(encoding="utf-8")
    for part in ('id="smoke_cells"', 'id="smoke_deltas"', 'data-scene="room"', "data:image/svg+xml",
                 "4 cells on 1 scene, 1 seed; none failed"):
        assert part in page, part
    assert (report / "report.md").is_file() and (report / "survey" / "smoke" / "other" / "room.csv").is_file()
    assert len(list((report / "images").rglob("*.png"))) >= 4  # a truth, and renderings of two modes with their errors


def test_the_tables_hold_what_the_rows_say(results):
    with open(results / "report" / "tables" / "smoke_cells.csv", encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    printed = {(line["method"], line["threshold"]): (float(line["PSNR [dB]"]), float(line["#Gaussians"]))
               for line in lines}
    rows = rows_of(results / "results").values()
    assert {key[1] for key in printed} == {"0.005", "0.002"} and len(printed) == len(rows)
    assert sorted(printed.values()) == sorted((row["psnr"], row["num_gaussians"]) for row in rows)
