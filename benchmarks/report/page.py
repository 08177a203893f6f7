"""One static page: the tables, the figures and, for every scene, images under a slider. It needs no network."""
from __future__ import annotations

import base64
import os
from typing import Any, Dict, List, NamedTuple, Sequence

import jinja2
from matplotlib import colormaps
from matplotlib.colors import to_hex

from .curves import Picture
from .sliders import ERROR_COLORS, ERROR_FULL_SCALE
from .tables import Table

PAGE_NAME = "index.html"
GENERATOR = "dsmoe bench report"  # written into the page, so that a later report knows it as its own


class Section(NamedTuple):
    """What the page shows of one suite."""

    suite: str
    id: str  # in the page
    counts: str
    tables: List[Table]
    pictures: List[Picture]
    scenes: List[Dict[str, Any]]
    no_images: str  # why, where there are no scenes
    protocols: List[Dict[str, Any]]


def write_page(output: str, sections: Sequence[Section], commits: Sequence[str]) -> str:
    """Writes OUTPUT/index.html, figures inside it and images beside it; returns its path."""
    folder = os.path.dirname(os.path.abspath(__file__))
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(folder), autoescape=True, trim_blocks=True,
                                     lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    environment.filters["data_url"] = _data_url
    scale = ", ".join(to_hex(colormaps[ERROR_COLORS](step / 8)) for step in range(9))
    text = environment.get_template("page.html").render(
        generator=GENERATOR, sections=sections, commits=commits, error_scale=scale, error_full=f"{ERROR_FULL_SCALE:g}")
    path = os.path.join(output, PAGE_NAME)
    with open(path, "w", encoding="utf-8") as file:
        file.write(text)
    return path


def _data_url(path: str) -> str:
    with open(path, "rb") as file:
        return "data:image/svg+xml;base64," + base64.b64encode(file.read()).decode("ascii")
