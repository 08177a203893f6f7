"""The report's page: complete without a network, and usable in a browser by mouse and by keyboard, light and dark."""
from __future__ import annotations

import io
import json
import os
import re
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
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


class References(HTMLParser):
    """What a page loads."""

    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found += [value for name, value in attrs if name in ("src", "srcset", "href", "poster", "data")]


def test_everything_is_written(written):
    for form in ("md", "csv", "tex"):
        names = {path.stem for path in (written / "tables").glob(f"*.{form}")}
        assert names == {f"table1_{name}" for name in ("table1", "deltas", "cells", "failures")}
    assert {path.name for path in (written / "figures").iterdir()} == {
        f"table1-bonsai-{kind}{end}" for kind in ("rd", "time") for end in (".png", "-light.svg", "-dark.svg")}
    assert (written / "survey" / "table1" / "MipNeRF360" / "bonsai.csv").is_file()


def test_the_page_loads_nothing_but_its_own_files(written):
    text = (written / "index.html").read_text(encoding="utf-8")
    references = References(text).found
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


def test_a_folder_of_others_is_left_alone(tmp_path):
    (tmp_path / "report" / "images").mkdir(parents=True)
    with pytest.raises(ReportError, match="images is of no report"):
        report(write_rows(tmp_path / "results", [row()]), str(tmp_path / "report"))


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


def test_a_report_is_written_into_folders_alone_and_over_links(tmp_path, no_figures):
    results = write_rows(tmp_path / "results", [row()])
    (tmp_path / "file").touch()
    with pytest.raises(TrainerError, match="file: nothing can be written there .* choose another folder with -o"):
        report(results, str(tmp_path / "file"))
    report(results, str(tmp_path / "report"))
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "mine.txt").touch()
    shutil.rmtree(tmp_path / "report" / "tables")
    (tmp_path / "report" / "tables").symlink_to(tmp_path / "elsewhere")
    report(results, str(tmp_path / "report"))
    assert not (tmp_path / "report" / "tables").is_symlink() and list((tmp_path / "report" / "tables").iterdir())
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


@pytest.fixture(scope="module")
def browser():
    api = pytest.importorskip("playwright.sync_api", reason="the page is tried in a browser by playwright")
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with api.sync_playwright() as playwright:
        try:  # --no-sandbox: for containers, where tests run as root
            started = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        except api.Error as error:
            pytest.skip(f"no Chromium starts here: {str(error).strip().splitlines()[0]}")
        yield started
        started.close()


@pytest.fixture
def page(browser, written, request):
    """The page, opened from its file with the network off; whatever fails in it fails the test."""
    context = browser.new_context(color_scheme=getattr(request, "param", "light"), offline=True,
                                  viewport={"width": 1000, "height": 900})
    opened, complaints = context.new_page(), []
    opened.on("console", lambda message: complaints.append(message.text))
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    opened.on("requestfailed", lambda failure: complaints.append(failure.url))
    opened.goto((written / "index.html").as_uri())
    yield opened
    context.close()
    assert complaints == []


def colors_of(page):
    """The colours (left, right) in the middle row of the stage, at a tenth and nine tenths of its width."""
    stage = page.locator(".stage")
    page.wait_for_function("[...document.querySelectorAll('.stage img')].every(image => image.complete)")
    pixels = np.asarray(Image.open(io.BytesIO(stage.screenshot())).convert("RGB")).astype(int)
    line = pixels[pixels.shape[0] * 3 // 4]
    return tuple(line[len(line) // 10]), tuple(line[len(line) * 9 // 10])


def test_the_slider_shows_alpha_to_the_left_and_smoe_to_the_right(page):
    assert colors_of(page) == (ALPHA, SMOE)
    assert page.locator(".tag.left").inner_text().startswith("alpha · 14.84 dB")


def test_layers_views_and_settings_are_chosen(page):
    page.get_by_label("Left", exact=True).select_option("ground truth")
    assert colors_of(page) == (TRUTH, SMOE)
    page.get_by_label("Right", exact=True).select_option("error of alpha")
    left, right = colors_of(page)
    assert left == TRUTH and right not in (SMOE, ALPHA, TRUTH)
    page.get_by_label("View", exact=True).select_option(label="two")
    assert "bonsai, two: ground truth" == page.locator("[data-side=left]").get_attribute("alt")
    # The other setting has one view and no smoe: the choice that is gone falls back, the other stays.
    page.get_by_label("Setting", exact=True).select_option(label="native, threshold 0.0002")
    assert page.get_by_label("View", exact=True).locator("option").all_inner_texts() == ["three"]
    assert page.get_by_label("Right", exact=True).locator("option").all_inner_texts() == [
        "ground truth", "alpha", "error of alpha"]
    assert page.get_by_label("Left", exact=True).input_value() == "ground truth"
    assert colors_of(page)[0] == TRUTH
