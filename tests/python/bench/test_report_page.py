"""The report's folder and its page: complete without a network, replaced as a whole, nothing of others in it lost."""
import json
import os
import re
import shutil

import pytest
from checkouts import contents
from PIL import Image
from report_rows import ALPHA, PROTOCOL, SMOE, TRUTH, failed, row, write_images, write_rows

from dsmoe.bench.report import ReportError, images, report
from dsmoe.errors import TrainerError


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
    monkeypatch.setattr("dsmoe.bench.report.draw_all", lambda *_: [])


@pytest.fixture
def texts(tmp_path, no_figures):
    """From rows, and fields of the suite's record, to what a report of them says in report.md and in index.html."""
    def made(rows, **suite):
        results, output = write_rows(tmp_path / "results", rows), tmp_path / "report"
        (tmp_path / "results" / "suite.json").write_text(json.dumps(suite))
        report(results, str(output))
        return [(output / name).read_text(encoding="utf-8") for name in ("report.md", "index.html")]

    return made


def test_everything_is_written(written):
    assert {path.name for path in (written / "tables").iterdir()} == {
        f"table1_{name}.{form}" for name in ("table1", "deltas", "cells", "failures") for form in ("md", "csv", "tex")}
    assert {path.name for path in (written / "figures").iterdir()} == {"table1-bonsai-rd.png", "table1-bonsai-rd.svg"}


def test_the_page_loads_nothing_but_its_own_files(written):
    text = (written / "index.html").read_text(encoding="utf-8")
    references = re.findall(r'(?:src|srcset|href|poster|data)="([^"]*)"', text)
    files = [name for name in references if not name.startswith(("#", "data:"))]
    assert files and all((written / name).is_file() for name in files)
    assert not re.search(r"@import|url\(|https?://", re.sub(r"data:[^\"]*", "", text))
    # Of two views the truth, two renderings, two errors; of another the truth, its rendering and error; each is a link.
    assert len(set(files)) == 13


def test_a_report_that_fails_leaves_the_earlier_one(written, tmp_path, monkeypatch, no_figures):
    output = tmp_path / "report"
    shutil.copytree(written, output)
    before = contents(output)
    monkeypatch.setattr("dsmoe.bench.report._page", lambda *_: 1 / 0)  # written last
    with pytest.raises(ZeroDivisionError):
        report(write_rows(tmp_path / "results", [row("fox")]), str(output))
    assert contents(output) == before


@pytest.mark.parametrize("name, cells, told", [
    ("table1", [row()["cell"], "b"], "; 1 of 2 cells has no row yet: b."),
    ("table1", [*"edcba", row()["cell"]], "; 5 of 6 cells have no row yet: a; b; c; 2 more."),
    ("table1", [row()["cell"]], "."), ("table1", None, "."), ("table1", 3, "."), ("other", ["b"], ".")])
def test_cells_without_a_row_are_named(name, cells, told, texts):
    markdown, _ = texts([row()], name=name, cells=cells)
    assert markdown.split("\n")[4] == f"1 cell on 1 scene, 1 seed; none failed{told}"


def test_what_is_of_others_is_left_alone_and_what_is_of_an_earlier_report_goes(tmp_path, no_figures):
    results, report_folder = write_rows(tmp_path / "results", [row()]), tmp_path / "report"
    (tmp_path / "file").touch()
    with pytest.raises(TrainerError, match="file: nothing can be written there .* choose another folder with -o"):
        report(results, str(tmp_path / "file"))
    (report_folder / "images").mkdir(parents=True)
    with pytest.raises(TrainerError, match="is not empty .images., and nothing says that dsmoe bench report wrote it"):
        report(results, str(report_folder))
    (report_folder / "images").rmdir()
    report(results, str(report_folder))
    (report_folder / "mine.txt").touch()
    report(write_rows(tmp_path / "others", [row(suite="other")]), str(report_folder))
    assert {path.name for path in (report_folder / "tables").glob("*.md")} == {"other_cells.md", "other_table1.md"}
    assert (report_folder / "mine.txt").is_file()


def test_the_protocol_of_a_scene_is_what_its_cells_share_and_vary(texts):
    """And what is left out is said."""
    said = {**PROTOCOL, "arguments": ["--port", "0"]}
    other = row(seed=2, protocol={**PROTOCOL, "principal_point": "centre"})
    markdown, page = texts([row(protocol=said), failed(seed=1, iterations=7), other, row(
        blend_mode="smoe", schedule="steady", protocol=said, machine={"cells_per_gpu": 3})])
    assert ("2 seeds; 1 failed; left out, since principal_point is 'centre' in them and 'scene' in 2 others of bonsai: "
            f"{other['cell']}.") in markdown
    rules = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", page))
    assert rules["iterations"] == "30000" and rules["schedules"] == "3dgs; steady"
    assert rules["cells that shared their GPU or CPU"] == "1 of 2, up to 3 at once" and "arguments" not in rules


def test_renderings_stay_as_they_are_and_have_their_decibels(tmp_path):
    entry = row(blend_mode="smoe", background_gate=0.05)
    write_images(tmp_path / "results", entry, ALPHA, names=("a b",))
    (setting,) = images.collect(str(tmp_path / "results"), "s u", [entry], str(tmp_path))
    (view,) = setting["views"]
    # One of three channels is off by 80 of 255: 10 log10(3 (255 / 80)^2)
    assert [image["label"] for image in view["images"]] == [
        "ground truth", "smoe 0.05, 14.84 dB", "error of smoe 0.05"]
    for image, color in zip(view["images"], (TRUTH, ALPHA)):
        assert " " not in image["path"]
        with Image.open(tmp_path / image["path"]) as picture:
            assert picture.size == (48, 32) and picture.getcolors() == [(48 * 32, color)]


@pytest.mark.parametrize("changes", [{"truth": (99, 100, 100)}, {"size": (32, 48)}])
def test_images_of_different_truths_are_refused(tmp_path, changes):
    entries = [row(), row(blend_mode="smoe")]
    write_images(tmp_path, entries[0], ALPHA)
    write_images(tmp_path, entries[1], SMOE, **changes)
    with pytest.raises(ReportError, match="cannot be compared"):
        images.collect(str(tmp_path), "table1", entries, str(tmp_path / "report"))
