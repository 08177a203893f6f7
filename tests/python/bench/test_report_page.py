"""The report's folder and its page: complete without a network, replaced as a whole, nothing of others in it lost."""
from __future__ import annotations

import json
import os
import re
import shutil

import pytest
from report_rows import ALPHA, PROTOCOL, SMOE, TRUTH, failed, row, write_images, write_rows

pytest.importorskip("matplotlib", reason="a report needs matplotlib")
pytest.importorskip("jinja2", reason="a report needs jinja2")
from diff_smoe_rasterization.benchmarks.suite.report import ReportError, report, sliders, survey  # noqa: E402
from diff_smoe_rasterization.trainer.errors import TrainerError  # noqa: E402


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The folder of a report on two settings of one scene with images, and a failed cell."""
    folder = tmp_path_factory.mktemp("results")
    entries = [row(), row(blend_mode="smoe", psnr=22.0), row(threshold=0.0002, psnr=30.0),
               failed("<out of memory> & more", blend_mode="smoe", threshold=0.0002)]
    write_rows(folder, entries)
    write_images(folder, entries[0], ALPHA)
    write_images(folder, entries[1], SMOE)
    write_images(folder, entries[2], TRUTH, names=("three",))
    output = tmp_path_factory.mktemp("report")
    assert report(str(folder), str(output)) == os.path.join(str(output), "index.html")
    return output


@pytest.fixture
def no_figures(monkeypatch):
    """They take two seconds a report."""
    monkeypatch.setattr("diff_smoe_rasterization.benchmarks.suite.report.draw_all", lambda *_: [])


def test_everything_is_written(written):
    for form in ("md", "csv", "tex"):
        names = {path.stem for path in (written / "tables").glob(f"*.{form}")}
        assert names == {f"table1_{name}" for name in ("table1", "deltas", "cells", "failures")}
    assert {path.name for path in (written / "figures").iterdir()} == {
        f"table1-bonsai-{kind}{end}" for kind in ("rd", "time") for end in (".png", "-light.svg", "-dark.svg")}
    assert (written / "survey" / "table1" / "MipNeRF360" / "bonsai.csv").is_file()


def test_the_page_loads_nothing_but_its_own_files(written):
    text = (written / "index.html").read_text(encoding="utf-8")
    references = re.findall(r'(?:src|srcset|href|poster|data)="([^"]*)"', text)
    files = [name for name in references if not name.startswith(("#", "data:"))]
    assert files and all((written / name).is_file() for name in files)
    assert not re.search(r"@import|url\(|https?://", re.sub(r"data:[^\"]*", "", text))
    layers = set(re.findall(r'"path": "([^"]+)"', text))
    assert len(layers) == 13  # two views of truth, two renderings, two errors; one view of truth, rendering, error
    assert all((written / name).is_file() for name in layers)


def test_a_report_that_fails_leaves_the_earlier_one(written, tmp_path, monkeypatch, no_figures):
    output = tmp_path / "report"
    shutil.copytree(written, output)

    def files():
        return {path.relative_to(output).as_posix(): path.read_bytes() for path in output.rglob("*") if path.is_file()}

    before = files()
    monkeypatch.setattr(survey, "write_survey", lambda *_: 1 / 0)  # after tables and images
    with pytest.raises(ZeroDivisionError):
        report(write_rows(tmp_path / "results", [row("fox")]), str(output))
    assert files() == before


def test_cells_without_a_row_are_named(tmp_path, no_figures):
    def counts(rows, **suite):
        folder = tmp_path / "results"
        write_rows(folder, rows)
        (folder / "suite.json").write_text(json.dumps(suite))
        report(str(folder), str(tmp_path / "report"))
        return (tmp_path / "report" / "report.md").read_text(encoding="utf-8").split("\n")[4]

    entries, here = [row(), row(seed=1)], "1 cell on 1 scene, 1 seed; none failed"
    assert counts(entries[:1], name="table1", cells=[entries[0]["cell"], "b"]) == (
        f"{here}; 1 of 2 cells has no row yet: b.")
    assert counts(entries[:1], name="table1", cells=[*"edcba", entries[0]["cell"]]) == (
        f"{here}; 5 of 6 cells have no row yet: a; b; c; 2 more.")
    for suite in ({"name": "other", "cells": ["b"]}, {"name": "table1"}, {"name": "table1", "cells": 3}):
        assert counts(entries[:1], **suite) == f"{here}."
    assert counts(entries, name="table1", cells=[entry["cell"] for entry in entries]) == (
        "2 cells on 1 scene, 2 seeds; none failed.")


def test_what_is_of_others_is_left_alone(tmp_path, no_figures):
    results, report_folder = write_rows(tmp_path / "results", [row()]), tmp_path / "report"
    (tmp_path / "file").touch()
    with pytest.raises(TrainerError, match="file: nothing can be written there .* choose another folder with -o"):
        report(results, str(tmp_path / "file"))
    (report_folder / "images").mkdir(parents=True)
    with pytest.raises(ReportError, match="images is of no report"):
        report(results, str(report_folder))
    (report_folder / "images").rmdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "mine.txt").touch()
    report(results, str(report_folder))
    shutil.rmtree(report_folder / "tables")
    (report_folder / "tables").symlink_to(tmp_path / "elsewhere")
    report(results, str(report_folder))
    assert not (report_folder / "tables").is_symlink() and list((report_folder / "tables").iterdir())
    assert [path.name for path in (tmp_path / "elsewhere").iterdir()] == ["mine.txt"]


def test_the_protocol_of_a_scene_is_what_its_cells_share_and_vary(tmp_path, no_figures):
    said = {**PROTOCOL, "arguments": ["--port", "0"]}
    entries = [row(protocol=said), row(blend_mode="smoe", schedule="steady", protocol=said,
                                       machine={"cells_per_gpu": 3}), failed(seed=1, iterations=7)]
    report(write_rows(tmp_path / "results", entries), str(tmp_path / "report"))
    text = (tmp_path / "report" / "index.html").read_text(encoding="utf-8")
    rules = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", text))
    assert rules["iterations"] == "30000" and rules["schedules"] == "3dgs; steady"
    assert rules["cells that shared their GPU or CPU"] == "1 of 2, up to 3 at once" and "arguments" not in rules


def test_what_is_left_out_is_said(tmp_path, no_figures):
    other = row(seed=2, protocol={**PROTOCOL, "principal_point": "centre"})
    report(write_rows(tmp_path / "results", [row(), row(seed=1), other]), str(tmp_path / "report"))
    assert ("2 cells on 1 scene, 2 seeds; none failed; left out, since principal_point is 'centre' in them and 'scene' "
            f"in 2 others of bonsai: {other['cell']}.") in (tmp_path / "report" / "report.md").read_text("utf-8")


def test_renderings_are_copied_byte_for_byte(tmp_path):
    entry = row(blend_mode="smoe", background_gate=0.05)
    write_images(tmp_path / "results", entry, ALPHA, names=("a b",))
    found = sliders.collect(str(tmp_path / "results"), "s u", [entry], str(tmp_path))
    view, = found[0]["settings"][0]["views"]
    truth, gated, error = view["layers"]
    source = tmp_path / "results" / "cells" / entry["cell"] / "images"
    for layer, kind in ((truth, "gt"), (gated, "render")):
        assert (tmp_path / layer["path"]).read_bytes() == (source / kind / "a b.png").read_bytes()
    assert " " not in truth["path"] + gated["path"] + error["path"]
    # One of three channels is off by 80 of 255: 10 log10(3 (255 / 80)^2)
    assert gated["note"] == error["note"] == "14.84 dB"


@pytest.mark.parametrize("changes", [{"truth": (99, 100, 100)}, {"size": (32, 48)}])
def test_images_of_different_truths_are_refused(tmp_path, changes):
    entries = [row(), row(blend_mode="smoe")]
    write_images(tmp_path, entries[0], ALPHA)
    write_images(tmp_path, entries[1], SMOE, **changes)
    with pytest.raises(ReportError, match="cannot be compared"):
        sliders.collect(str(tmp_path), "table1", entries, str(tmp_path / "report"))
