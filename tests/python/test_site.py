"""The pages for users: links, commands, the README's program, and a documentation site without a warning."""
from __future__ import annotations

import dataclasses
import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def stage():
    """docs/site/stage.py as a module."""
    spec = importlib.util.spec_from_file_location("stage", ROOT / "docs" / "site" / "stage.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_link_of_a_page_leads_somewhere(stage):
    pages = list(stage.markdown_files())
    assert ROOT / "README.md" in pages and ROOT / "docs" / "method.md" in pages
    missing = [f"{page.relative_to(ROOT)}: {target}" for page in pages
               for target in stage.LINK.findall(page.read_text(encoding="utf-8"))
               if not re.match(r"https?:|mailto:", target) and not (page.parent / target).exists()
               and target != "cpp_headers.md"]  # made by stage.py
    assert not missing


def anchors(page):
    """The anchors of a page's headings, as code hosts and the site make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = (re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", line) for line in re.findall(r"^#+ (.*)$", text, re.MULTILINE))
    return {re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in headings}


def test_every_link_into_a_page_leads_to_a_heading(stage):
    links = [(page, *link) for page in stage.markdown_files()
             for link in re.findall(r"\]\(((?!https?:)[^)#\s]*)#([^)\s]+)\)", page.read_text(encoding="utf-8"))]
    assert len(links) > 100
    missing = [f"{page.relative_to(ROOT)}: {target}#{anchor}" for page, target, anchor in links
               if (page.parent / target).suffix == ".md" and anchor not in anchors(page.parent / target)
               or not target and anchor not in anchors(page)]
    assert not missing


def test_every_dsmoe_command_of_a_page_can_be_typed(stage):
    from dsmoe.arguments import build_parser

    typed = []
    for page in stage.markdown_files():
        text = re.sub(r"\\\n\s*", "", page.read_text(encoding="utf-8"))  # lines that go on
        for line in re.findall(r"^ {4}(dsmoe .*)$", text, re.MULTILINE):
            words = shlex.split(re.sub(r"[()]", "", line), comments=True)
            commands = " ".join(words).split(" && ")
            typed += [(page.name, command) for command in commands if command.startswith("dsmoe ")]
    assert len(typed) > 25
    refused = []
    for name, command in typed:
        try:
            build_parser().parse_args([word if word != "N" else "4" for word in command.split()[1:]])
        except SystemExit:
            refused.append(f"{name}: {command}")
    assert not refused


# Words of each page (`wc -w`) that its reader can be asked to read. A page that needs more takes them from another.
WORDS = {
    "README.md": 1280, "CHANGELOG.md": 40, "CONTRIBUTING.md": 150, "DEVELOPING.md": 2990, "benchmarks/NOTES.md": 3200,
    "benchmarks/README.md": 920, "benchmarks/RESULTS.md": 2080, "benchmarks/harness/report/table.md": 80,
    "benchmarks/timing/README.md": 380, "docs/cpp.md": 760, "docs/cuda.md": 1260, "docs/distributed.md": 820,
    "docs/install.md": 810, "docs/look.md": 630, "docs/method.md": 2070, "docs/paper.md": 1430, "docs/scenes.md": 630,
    "docs/settings.md": 1830, "docs/simplify.md": 670, "docs/site/python.md": 110, "docs/start.md": 320,
    "docs/tools.md": 440, "docs/trainer.md": 1370, "docs/trainers.md": 480, "docs/usage.md": 1450,
    "examples/README.md": 180, "examples/libtorch/README.md": 180, "integrations/README.md": 920,
    "patches/README.md": 1020}
ALL_WORDS = 28500  # of all pages together; WORDS sums to it


def test_the_pages_together_stay_short(stage):
    pages = {str(page.relative_to(ROOT)): len(page.read_text(encoding="utf-8").split())
             for page in stage.markdown_files()}
    assert set(pages) == set(WORDS), "each page has its number of words"
    most = max(pages, key=lambda page: pages[page] - WORDS[page])
    assert sum(pages.values()) <= ALL_WORDS, (
        f"{sum(pages.values())} words, and {ALL_WORDS} are allowed; {most} has grown most: {pages[most]} words, and "
        f"{WORDS[most]} are meant")


def test_the_site_shows_every_page_of_docs():
    shown = re.findall(r": (\S+\.md)$", (ROOT / "docs" / "site" / "mkdocs.yml").read_text(encoding="utf-8"),
                       re.MULTILINE)
    assert {f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")} <= set(shown)
    assert len(shown) == len(set(shown))


def settings_tables():
    """The rows of docs/settings.md by heading: {heading: [(names, defaults, range)]}."""
    tables, heading = {}, ""
    for line in (ROOT / "docs" / "settings.md").read_text(encoding="utf-8").splitlines():
        heading = line.lstrip("# ") if line.startswith("#") else heading
        if line.startswith("| `"):
            cells = [cell.strip() for cell in line.strip("|").split(" | ")]
            tables.setdefault(heading, []).append([re.findall("`([^`]*)`", cell) or cell for cell in cells[:3]])
    return tables


def limits(said):
    """Values that a range of the page holds, at its ends, and values just outside."""
    if isinstance(said, list):
        return ([True, False], []) if said == ["True", "False"] else (said, ["x"])
    number = r"(-?[\d.e]+)"
    patterns = ((f"{number} or more", lambda a: ([a], [a - 1])), ("above 0", lambda: ([1e-9], [0])),
                (f"above 0 to {number}", lambda a: ([1e-9, a], [0, 2 * a])),
                (f"{number} to {number}", lambda a, b: ([a, b], [a - 1, 2 * b + 1])),
                (f"{number} to below {number}", lambda a, b: ([a], [a - 1, b])),
                (f"{number}, or {number} or more", lambda a, b: ([a, b], [a - 1, b - 0.5])))
    for pattern, ends in patterns:
        found = re.fullmatch(pattern, said)
        if found:
            return ends(*map(float, found.groups()))
    assert said == "text" or "finite" in said, said
    return [], []


def accepts(call, name, value, like):
    """Whether a setting may have a value, which is made one of the type of `like`."""
    value = int(value) if isinstance(value, float) and type(like) is int else value
    try:
        call(**{name: value})
        return True
    except ValueError:
        return False


def test_the_page_of_settings_says_what_the_code_does(stage):
    from scenes import random_scene

    from diff_smoe_rasterization import GaussianRasterizationSettings, rasterize
    from dsmoe.options.config import TrainConfig
    from dsmoe.options.importance_options import ImportanceOptions, parse_importance_options

    tables = settings_tables()
    scene = random_scene("smoe", 5, 20, 18)
    scene.inputs["shs"] = torch.zeros(5, 16, 3, dtype=scene.inputs["means3D"].dtype)  # of all degrees

    def render(**changed):
        if changed.get("rolling_shutter", "global") != "global":
            changed.update(viewmatrix_end=scene.settings.viewmatrix, principal_point=(10.0, 9.0))
        rasterize(settings=scene.settings._replace(**changed), **scene.inputs)

    def train(**changed):
        budget = {"budget": 100} if changed.get("strategy") in ("importance", "mcmc") else {}  # which need one
        return TrainConfig(**{"blend_mode": "smoe", **budget, **changed}).validate()

    eq7, moved = train(blend_mode="smoe_eq7"), train(strategy="importance", budget=100)
    usual = {field.name: field.default for field in dataclasses.fields(TrainConfig)}
    depending = {name for name in usual if usual[name] is None} - {"blend_mode", "background_gate", "strategy"}
    defaults = {name: [repr(getattr(train(), name)), repr(getattr(other, name))] for name in depending
                for other in (eq7, moved) if getattr(train(), name) != getattr(other, name)}
    importance = {field.name: field.default for field in dataclasses.fields(ImportanceOptions)}
    for heading, names, default_of, like, call in (
            ("A rendering", GaussianRasterizationSettings._fields,
             lambda name: [repr(GaussianRasterizationSettings._field_defaults[name])]
             if name in GaussianRasterizationSettings._field_defaults else "none", scene.settings._asdict(), render),
            ("A training", list(usual), lambda name: defaults.get(name) or ("none" if usual[name] == "" else [
                usual[name] if isinstance(usual[name], str) else repr(usual[name])]), usual, train),
            ("The strategy importance", list(importance), lambda name: [repr(importance[name])], importance,
             lambda **given: parse_importance_options("{}={}".format(*next(iter(given.items())))))):
        rows = tables[heading]
        assert [name for (name,), *_ in rows] == list(names), heading
        for (name,), default, said in rows:
            assert default == default_of(name), f"{heading}: {name} is {default_of(name)}, and the page says {default}"
            said = said.partition(", or `")[0] if isinstance(said, str) else said
            inside, outside = limits("0 to 1e30" if said == ["learned"] else said)
            for value in inside[:1] if name.startswith("image_") else inside:
                assert accepts(call, name, value, like[name]), f"{heading}: {name} may not be {value}"
            for value in outside:
                assert not accepts(call, name, value, like[name]), f"{heading}: {name} may be {value}"


def test_the_words_of_the_kernels_name_what_the_code_has(stage):
    words = (ROOT / "docs" / "cuda.md").read_text(encoding="utf-8").partition("## Words")[2].partition("\n## ")[0]
    assert re.findall(r"^- \*\*(\w+)\*\*:", words, re.MULTILINE) == (
        "pair strong tail near faint covered wide footprint instance entry square quarter mark segment "
        "capacity").split()
    code = "\n".join(path.read_text(encoding="utf-8") for folder in (stage.INCLUDE, stage.INCLUDE.parents[1] / "csrc")
                     for path in folder.rglob("*.*h"))
    for name, number in (("kStrongAlpha", "1/2040"), ("kAlphaCut", "1/255"), ("kCoreAlpha", "1/1020"),
                         ("kSegmentLength", "512")):
        assert number in words and name in words
        said = re.search(rf"\b{name} = ([^;]*);", code)[1].replace(".0f", "").replace(" ", "")
        said = said.replace("kAlphaCut/4", "1/1020")  # as kAlphaCut is 1/255
        assert said == number, f"{name} is {said}"
    assert not [name for name in re.findall(r"`(k[A-Z]\w+)`", words) if not re.search(rf"\b{name}\b", code)]


def test_the_page_of_settings_has_every_variable():
    read = set()
    for name in ("dsmoe", "benchmarks/harness", "diff_smoe_rasterization", "patches", "integrations", "setup.py",
                 "tests", "build_support", "quickstart", "check", "docs"):
        for path in [ROOT / name] if (ROOT / name).is_file() else (ROOT / name).rglob("*"):
            if path.suffix in (".py", ".cpp", ".yaml") or not path.suffix and path.is_file():
                text = path.read_text(encoding="utf-8", errors="replace")
                read.update(re.findall(r'(?:getenv\(|environ\.get\(|environ\[|VARIABLE = |DEMO = |'
                                       r'"(?:vgg|alex)": )"(DSMOE_\w+)"', text))
                read.update(re.findall(r"\$\{?(DSMOE_\w+)", text) if path.suffix in ("", ".sh", ".yaml") else ())
    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    said = set(re.findall(r"`(DSMOE_\w+)`", page.partition("## The environment")[2]))
    assert said == read - {"DSMOE_X"}


def test_the_page_of_headers_has_declarations_and_no_bodies(stage):
    text = stage.header_pages()
    headers = re.findall(r"^## (.*)$", text, re.MULTILINE)
    public = {f"dsmoe/{path.relative_to(stage.INCLUDE)}" for path in stage.INCLUDE.rglob("*.h")}
    assert set(headers) == public | {f"io/{name}" for name in stage.IO_HEADERS}
    declaration = "template <class S> void forward(Frame<S>& frame, const Run& run, Allocator& memory);"
    assert declaration in text and "// Renders frame.inputs to frame.images and fills frame.saved." in text
    for path in stage.INCLUDE.glob("*.h"):
        shown = "\n".join(stage.declarations(path.read_text(encoding="utf-8")))
        assert shown.count("{") == shown.count("}") and "  return " not in shown and "for (" not in shown, path.name


def test_the_site_shows_the_page_that_is_named(stage, tmp_path, monkeypatch):
    (tmp_path / "model.html").write_text("<p>a model</p>", encoding="utf-8")
    monkeypatch.setenv(stage.DEMO, str(tmp_path / "model.html"))
    stage.main(tmp_path / "site")
    docs = tmp_path / "site" / "pages" / "docs"
    assert (docs / "demo.html").read_text(encoding="utf-8") == "<p>a model</p>"
    assert "](demo.html)" in (docs / "look.md").read_text(encoding="utf-8")
    assert "](docs/demo.html)" in (docs.parent / "README.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_site_builds_without_a_warning(stage, tmp_path):
    for name in ("mkdocs", "material", "mkdocstrings", "ruff"):
        pytest.importorskip(name)
    stage.main(tmp_path / "source")
    result = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(tmp_path / "source" / "mkdocs.yml"), "-d",
         str(tmp_path / "site")], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, universal_newlines=True,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    assert result.returncode == 0, result.stdout
    pages = {path.relative_to(tmp_path / "site").as_posix() for path in (tmp_path / "site").rglob("*.html")}
    assert {"index.html", "docs/method.html", "docs/trainers.html", "benchmarks/RESULTS.html"} <= pages
    python = (tmp_path / "site" / "docs" / "site" / "python.html").read_text(encoding="utf-8")
    assert 'id="diff_smoe_rasterization.rasterizer.rasterize"' in python and "may exceed 1" in python
    loaded = re.findall(r'(?:src|href)="(https?:[^"]*\.(?:js|css|woff2?))', python)
    assert not loaded, "nothing is loaded from elsewhere"


README = Path(__file__).resolve().parents[2] / "README.md"


def test_the_program_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    program, = re.findall(r"^```python\n(.*?)^```$", README.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    torch.manual_seed(0)
    variables = {}
    exec(program, variables)
    assert variables["color"].shape == (3, 240, 320) and variables["color"].max() > 0.1
    assert (variables["radii"] > 0).any() and variables["radii"].shape == (1000,)
    assert variables["means3D"].grad.any() and variables["means2D"].grad.any()
    assert "Gaussians in the image" in capsys.readouterr().out and (tmp_path / "smoe.png").stat().st_size > 1000


def test_what_a_patch_writes_into_a_checkout_is_public():
    from dsmoe.patches import fuse, modernise, runtime
    from dsmoe.patches.trainers import TRAINERS

    public = (ROOT / "DEVELOPING.md").read_text(encoding="utf-8").partition("**Frozen")[2].partition("\n## ")[0]
    frozen = {name: set(re.findall(r"`(\w+)`", names)) for name, names in re.findall(
        r"^- `([\w.]+)`: (.*?)(?=^- )", public, re.MULTILINE | re.DOTALL)}
    patchable = [trainer for trainer in TRAINERS if trainer.entries]
    assert frozen["dsmoe.patches.runtime"] == {
        "chosen_blend", *(trainer.default for trainer in TRAINERS),
        *(entry.blend for trainer in TRAINERS for entry in trainer.entries)}
    assert frozen["diff_smoe_rasterization.integrations"] == {trainer.flavour for trainer in patchable}
    assert all(callable(getattr(runtime, name)) for name in frozen["dsmoe.patches.runtime"])
    assert callable(fuse.start) and callable(modernise.start)


def test_every_page_has_the_version_of_the_package():
    from diff_smoe_rasterization import __version__

    for page, pattern, times in (("CITATION.cff", r"^version: (.*)$", 1), ("docs/install.md", r"/v([\d.]+)$", 2),
                                 ("docs/install.md", r"diff_smoe_rasterization-([\d.]+)\+", 1),
                                 ("CHANGELOG.md", r"^## (.*)$", 1)):
        found = re.findall(pattern, (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)
        assert found[:times] == [__version__] * times, f"{page}: {found}"
