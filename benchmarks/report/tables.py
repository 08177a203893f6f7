"""A table of labels and figures, and its three forms: Markdown, CSV, LaTeX."""
from __future__ import annotations

import csv
import io
import itertools
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

from .rows import LPIPS, Measured

DASH = "–"
OURS, PAPER = "ours", "paper"
# How a figure is headed and with how many digits it is printed.
FIGURES: Dict[str, Tuple[str, int]] = {
    "seeds": ("seeds", 0),
    "psnr": ("PSNR [dB]", 2),
    "psnr_float": ("PSNR, floats [dB]", 2),
    "psnr_edge": ("PSNR at edges [dB]", 2),
    "ssim": ("SSIM", 3),
    "num_gaussians": ("#Gaussians", 0),
    "num_gaussians_m": ("#G [M]", 3),
    "size_own_mb": ("own size [MB]", 1),
    "size_common_mb": ("common size [MB]", 1),
    "train_seconds": ("train [s]", 0),
    "wall_seconds": ("wall [s]", 0),
    "fps": ("FPS", 0),
    "peak_gpu_mib": ("GPU peak [MiB]", 0),
    "learned_gate": ("learned gate", 3),
}
LPIPS_NAMES = {"lpips_alex": "LPIPS Alex", "lpips_vgg_std": "LPIPS VGG", "lpips_vgg_inria": "LPIPS VGG as 3DGS",
               "paper": "LPIPS, paper's"}


class Column(NamedTuple):
    """A column of figures; columns of one group stand under one heading."""

    name: str
    digits: int
    group: str = ""
    signed: bool = False

    @property
    def full_name(self) -> str:
        return f"{self.group} {self.name}".strip()


class Cell(NamedTuple):
    """A figure with its spread, or a text in its place; printed: as the paper prints it."""

    value: Optional[float] = None
    spread: Optional[float] = None
    text: str = ""
    printed: str = ""

    def shown(self, column: Column, plus_minus: str = " ± ") -> str:
        if self.printed:
            return self.printed
        if self.value is None:
            return self.text or DASH
        value = round(self.value, column.digits) + 0.0  # no "-0.00"
        spread = "" if self.spread is None else f"{plus_minus}{self.spread:,.{column.digits}f}"
        return f"{value:{'+' if column.signed and value else ''},.{column.digits}f}{spread}"


class TableRow(NamedTuple):
    """Labels, then one cell for each column; source: OURS, or PAPER for figures that are the paper's."""

    labels: Tuple[str, ...]
    cells: Tuple[Cell, ...]
    source: str = OURS


class Table(NamedTuple):
    """labels: the headings of the first columns."""

    name: str  # of its files
    title: str
    labels: Tuple[str, ...]
    columns: Tuple[Column, ...]
    rows: Tuple[TableRow, ...]
    notes: Tuple[str, ...] = ()

    def headings(self) -> List[Tuple[str, int]]:
        """The groups of columns, each with its number of columns."""
        groups = itertools.groupby(self.columns, key=lambda column: column.group)
        return [(group, len(list(columns))) for group, columns in groups]


def column(name: str, group: str = "", difference: bool = False) -> Column:
    """The column of a figure, or of its differences."""
    heading, digits = (LPIPS_NAMES.get(name[len(LPIPS):], name), 3) if name.startswith(LPIPS) else FIGURES[name]
    return Column("Δ " + heading if difference else heading, digits, group, difference)


def cell(figure: Measured) -> Cell:
    """A measured figure as a cell."""
    return Cell(figure.mean, figure.spread, figure.why)


def printed(text: str) -> Cell:
    """One of the paper's figures, as printed there."""
    return Cell(float(text), printed="0" + text if text.startswith(".") else text)


def without_empty_columns(table: Table) -> Table:
    """The table without the columns that no row has anything in."""
    kept = [index for index in range(len(table.columns))
            if any(row.cells[index].value is not None or row.cells[index].text for row in table.rows)]
    rows = tuple(row._replace(cells=tuple(row.cells[index] for index in kept)) for row in table.rows)
    return table._replace(columns=tuple(table.columns[index] for index in kept), rows=rows)


def to_markdown(table: Table) -> str:
    """A heading, a Markdown table, then the notes as a list."""
    head = ["source", *table.labels, *(column.full_name for column in table.columns)]
    rule = ["---"] * (1 + len(table.labels)) + ["---:"] * len(table.columns)
    body = [[row.source, *row.labels, *_shown(table, row)] for row in table.rows]
    lines = ["| " + " | ".join(text.replace("|", "\\|").replace("\n", " ") for text in line) + " |"
             for line in [head, rule, *body]]
    notes = [f"- {note}" for note in table.notes]
    return "\n".join([f"### {table.title}", "", *lines, *([""] + notes if notes else []), ""])


def to_csv(table: Table) -> str:
    """Figures unrounded, ours with a column of their spread wherever a row has one."""
    with_spread = [any(row.cells[index].spread is not None for row in table.rows)
                   for index in range(len(table.columns))]
    head: List[Any] = ["source", *table.labels]
    for column_, spread in zip(table.columns, with_spread):
        head += [column_.full_name] + ([f"{column_.full_name} sd"] if spread else [])
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    for row in table.rows:
        line: List[Any] = [row.source, *row.labels]
        for entry, spread in zip(row.cells, with_spread):
            line.append(entry.printed or (entry.text if entry.value is None else _unrounded(entry.value)))
            if spread:
                line.append("" if entry.spread is None else repr(entry.spread))
        writer.writerow(line)
    return text.getvalue()


def _unrounded(value: float) -> str:
    """The number; a whole one without ".0"."""
    return str(int(value)) if float(value).is_integer() else repr(value)


def to_latex(table: Table) -> str:
    """A table for booktabs; the paper's rows are in italics and marked."""
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{_escaped(table.title)}}}",
             rf"\begin{{tabular}}{{l{'l' * len(table.labels)}{'r' * len(table.columns)}}}", r"\toprule"]
    if any(column.group for column in table.columns):
        spans = [f"\\multicolumn{{{width}}}{{c}}{{{_escaped(group)}}}" for group, width in table.headings()]
        lines.append(" & ".join([""] * len(table.labels) + [""] + spans) + r" \\")
    lines += [_latex_line(["source", *table.labels, *(column.name for column in table.columns)]), r"\midrule"]
    before: Optional[str] = None
    for row in table.rows:
        if before is not None and row.labels[0] != before:
            lines.append(r"\midrule")
        before = row.labels[0]
        texts = [row.source, *row.labels, *_shown(table, row, r" $\pm$ ")]
        lines.append(_latex_line(texts, r"\textit" if row.source == PAPER else ""))
    lines += [r"\bottomrule", r"\end{tabular}"]
    lines += [rf"\par\footnotesize {_escaped(note)}" for note in table.notes]
    return "\n".join([*lines, r"\end{table}", ""])


def _shown(table: Table, row: TableRow, plus_minus: str = " ± ") -> List[str]:
    return [entry.shown(column_, plus_minus) for entry, column_ in zip(row.cells, table.columns)]


def _latex_line(texts: Sequence[str], command: str = "") -> str:
    escaped = [_escaped(text) for text in texts]
    return " & ".join(f"{command}{{{text}}}" if command else text for text in escaped) + r" \\"


def _escaped(text: str) -> str:
    """For LaTeX; a plus-minus in mathematics is left as it is."""
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--",
               "−": "$-$", "×": r"$\times$", "Δ": r"$\Delta$", "≥": r"$\geq$", "\n": " "}
    parts = text.split(r" $\pm$ ")
    return r" $\pm$ ".join("".join(special.get(letter, "\\" + letter if letter in "&%$#_{}" else letter)
                                   for letter in part) for part in parts)
