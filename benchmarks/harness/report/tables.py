"""A table of labels and figures, and its forms: Markdown, LaTeX, CSV."""
from __future__ import annotations

import csv
import io
import itertools
from pathlib import Path
from typing import Dict, List, NamedTuple, Tuple

import jinja2

from .groups import LPIPS, Cell

OURS, PAPER = "ours", "paper"  # whose figures a row has
# How a figure is headed and with how many digits it is printed.
FIGURES: Dict[str, Tuple[str, int]] = {
    "scenes": ("scenes", 0), "seeds": ("seeds", 0), "psnr": ("PSNR [dB]", 2), "psnr_float": ("PSNR, floats [dB]", 2),
    "psnr_edge": ("PSNR at edges [dB]", 2), "ssim": ("SSIM", 3), "num_gaussians": ("#Gaussians", 0),
    "num_gaussians_m": ("#G [M]", 3), "size_own_mb": ("own size [MB]", 1), "size_common_mb": ("common size [MB]", 1),
    "train_seconds": ("train [s]", 0), "wall_seconds": ("wall [s]", 0), "fps": ("FPS", 0),
    "peak_gpu_mib": ("GPU peak [MiB]", 0), "learned_gate": ("learned gate", 3),
}
LPIPS_NAMES = {"lpips_alex": "LPIPS Alex", "lpips_vgg_std": "LPIPS VGG", "lpips_vgg_inria": "LPIPS VGG as 3DGS",
               "paper": "LPIPS, paper's"}


class Column(NamedTuple):
    name: str
    digits: int
    group: str = ""  # the heading above it, which it shares with its neighbours
    signed: bool = False

    @property
    def full_name(self) -> str:
        return f"{self.group} {self.name}".strip()


class TableRow(NamedTuple):
    labels: Tuple[str, ...]
    cells: List[Cell]
    source: str = OURS


class Table(NamedTuple):
    name: str  # of its files
    title: str
    labels: Tuple[str, ...]  # the headings of the first columns
    columns: List[Column]
    rows: List[TableRow]
    notes: List[str]

    def without_empty_columns(self) -> Table:
        kept = [any(cell.value is not None or cell.text for cell in column)
                for column in zip(*(row.cells for row in self.rows))]
        return self._replace(columns=list(itertools.compress(self.columns, kept)),
                             rows=[row._replace(cells=list(itertools.compress(row.cells, kept))) for row in self.rows])

    def headings(self) -> List[Tuple[str, int]]:
        groups = itertools.groupby(self.columns, key=lambda column: column.group)
        return [(group, len(list(columns))) for group, columns in groups]

    def head(self, named: str) -> List[str]:
        return ["source", *self.labels, *(getattr(column, named) for column in self.columns)]

    def shown(self, row: TableRow, plus_minus: str = " ± ") -> List[str]:
        return [cell.shown(column.digits, column.signed, plus_minus) for cell, column in zip(row.cells, self.columns)]

    def lines(self, plus_minus: str = " ± ") -> List[List[str]]:
        return [[row.source, *row.labels, *self.shown(row, plus_minus)] for row in self.rows]


def column(name: str, group: str = "", difference: bool = False) -> Column:
    heading, digits = (LPIPS_NAMES.get(name[len(LPIPS):], name), 3) if name.startswith(LPIPS) else FIGURES[name]
    return Column("Δ " + heading if difference else heading, digits, group, difference)


PLUS_MINUS = r" $\pm$ "
SPECIAL = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--", "−": "$-$",
           "×": r"$\times$", "Δ": r"$\Delta$", "≥": r"$\geq$", "\n": " ",
           **{sign: "\\" + sign for sign in "&%$#_{}"}}


def _escaped(text: str) -> str:
    """For LaTeX; a plus-minus in mathematics is left as it is."""
    return PLUS_MINUS.join("".join(SPECIAL.get(letter, letter) for letter in part) for part in text.split(PLUS_MINUS))


TEXTS = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent), variable_start_string="<<",
                           variable_end_string=">>", undefined=jinja2.StrictUndefined, trim_blocks=True,
                           lstrip_blocks=True, keep_trailing_newline=True)
TEXTS.filters.update(tex=_escaped, md=lambda text: text.replace("|", "\\|").replace("\n", " "))


def to_text(table: Table, form: str) -> str:
    """form: "md", "tex" (booktabs; the paper's rows are in italics) or "csv"."""
    return to_csv(table) if form == "csv" else TEXTS.get_template(f"table.{form}").render(
        table=table, plus_minus=PLUS_MINUS)


def to_csv(table: Table) -> str:
    """Figures unrounded, ours with a column of their spread wherever a row has one."""
    spread = [any(cell.spread is not None for cell in column) for column in zip(*(row.cells for row in table.rows))]
    lines = [["source", *table.labels], *([row.source, *row.labels] for row in table.rows)]
    figures = [[(name.full_name, f"{name.full_name} sd") for name in table.columns],
               *([(cell.unrounded(), "" if cell.spread is None else repr(cell.spread)) for cell in row.cells]
                 for row in table.rows)]
    for line, pairs in zip(lines, figures):
        line += [text for pair, wide in zip(pairs, spread) for text in pair[:1 + wide]]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()
