"""The pages for users: links, commands, the README's program, and a documentation site without a warning."""
from __future__ import annotations

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


def test_the_program_runs():
    program, = re.findall(r"^```python\n(.*?)^```$", README.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    torch.manual_seed(0)
    variables = {}
    exec(program, variables)
    assert variables["color"].shape == (3, 240, 320) and variables["color"].max() > 0.1
    assert (variables["radii"] > 0).any() and variables["radii"].shape == (1000,)
    assert variables["means3D"].grad.any() and variables["means2D"].grad.any()
