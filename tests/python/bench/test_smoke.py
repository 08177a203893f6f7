"""The shipped suite `smoke` from end to end, as a user types it: run, then report."""
from __future__ import annotations

import csv
import subprocess

import pytest
from bench_commands import command, environment, rows_of

for library in ("yaml", "snakemake", "matplotlib", "jinja2"):
    pytest.importorskip(library, reason="`dsmoe bench` needs it: pip install '.[bench]', with Python 3.11 or later")


@pytest.mark.slow  # a minute; test_engine.py goes from a smaller suite to its report
def test_the_suite_smoke(tmp_path):
    for words in (["run", "smoke", "-o", "results"], ["report", "results", "-o", "report"]):
        done = subprocess.run(command("bench", *words), env=environment(), cwd=str(tmp_path), stdout=subprocess.PIPE,
                              stderr=subprocess.STDOUT)
        assert done.returncode == 0, done.stdout.decode(errors="replace")
    rows = list(rows_of(tmp_path / "results").values())
    for row in rows:
        halfway, = row["history"]
        assert row["ok"] and halfway["iteration"] == 150 and row["psnr"] > halfway["psnr"]
    with open(tmp_path / "report" / "tables" / "smoke_cells.csv", encoding="utf-8", newline="") as file:
        printed = [(float(line["PSNR [dB]"]), float(line["#Gaussians"])) for line in csv.DictReader(file)]
    assert sorted(printed) == sorted((row["psnr"], row["num_gaussians"]) for row in rows) and len(printed) == 4
