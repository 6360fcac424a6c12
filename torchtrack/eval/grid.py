"""A table as text, and the forms it is written in: Markdown, LaTeX, CSV and JSON."""

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchtrack.core.atomic import atomic_path
from torchtrack.run.sinks.summary import finite

_LATEX = {"\\": r"\textbackslash{}", "°": r"$^\circ$", "δ": r"$\delta$", "Δ": r"$\Delta$", "†": r"$^\dagger$"}
_LATEX |= {character: f"\\{character}" for character in "&%$#_{}"}


@dataclass(frozen=True)
class Cell:
    """One entry: its text, over how many columns it spans, and whether it is to stand out."""

    text: str
    span: int = 1
    bold: bool = False


@dataclass(frozen=True)
class Grid:
    """A table.

    Args:
        title: what it shows, with the units.
        header: rows of headings, the widest spans first; each row spans all columns.
        rows: the entries, one per column.
        notes: remarks below the table.
    """

    title: str
    header: tuple[tuple[Cell, ...], ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Report:
    """Tables, and the figures in them as records: one per figure, name to value."""

    grids: tuple[Grid, ...]
    records: tuple[Mapping[str, Any], ...]

    def write(self, folder: Path) -> None:
        """Write ``tables.md``, ``tables.tex``, ``tables.csv`` and ``tables.json`` into a folder."""
        texts = {
            "md": "\n\n".join(markdown(grid) for grid in self.grids) + "\n",
            "tex": "\n\n".join(latex(grid) for grid in self.grids) + "\n",
            "csv": _csv(self.records),
            "json": json.dumps(finite([dict(record) for record in self.records]), indent=2, ensure_ascii=False, allow_nan=False) + "\n",
        }
        for suffix, text in texts.items():
            with atomic_path(folder / f"tables.{suffix}") as path:
                path.write_text(text, encoding="utf-8")


def headings(grid: Grid) -> list[str]:
    """One heading per column: the texts above it, from the widest to its own; above the names of the rows, the last alone."""
    rows = [[cell.text for cell in row for _ in range(cell.span)] for row in grid.header]
    names, *columns = zip(*rows, strict=True)
    return [names[-1], *(" ".join(text for text in column if text) for column in columns)]


def markdown(grid: Grid) -> str:
    """The table in Markdown, aligned to be read as it is."""
    body = [[f"**{cell.text}**" if cell.bold and cell.text else cell.text for cell in row] for row in grid.rows]
    rows = [headings(grid), *body]
    widths = [max(3, *(len(row[column]) for row in rows)) for column in range(len(rows[0]))]
    lines = ["| " + " | ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) + " |" for row in rows]
    # The first column holds names, the others figures.
    rule = "|" + "|".join("-" * (width + 1) + ("-" if column == 0 else ":") for column, width in enumerate(widths)) + "|"
    return "\n".join([f"**{grid.title}**", "", lines[0], rule, *lines[1:], *(f"\n{note}" for note in grid.notes)])


def latex(grid: Grid) -> str:
    """The table in LaTeX, for the package booktabs."""
    columns = sum(cell.span for cell in grid.header[0])
    header = [line for row in grid.header for line in (_latex_row(row), _rules(row)) if line]
    body = [_latex_row(row) for row in grid.rows]
    return "\n".join(
        [
            r"\begin{table*}[htbp]",
            r"\centering",
            rf"\caption{{{_escaped(grid.title)}}}",
            rf"\begin{{tabular}}{{l{'c' * (columns - 1)}}}",
            r"\toprule",
            *header,
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            *(rf"\par\footnotesize {_escaped(note)}" for note in grid.notes),
            r"\end{table*}",
        ]
    )


def _latex_row(row: Sequence[Cell]) -> str:
    return " & ".join(_latex_cell(cell) for cell in row) + r" \\"


def _latex_cell(cell: Cell) -> str:
    text = _escaped(cell.text)
    text = rf"\textbf{{{text}}}" if cell.bold and text else text
    return rf"\multicolumn{{{cell.span}}}{{c}}{{{text}}}" if cell.span > 1 else text


def _rules(row: Sequence[Cell]) -> str:
    """A rule under each heading that spans columns; nothing where none does."""
    rules, column = [], 1
    for cell in row:
        if cell.span > 1:
            rules.append(rf"\cmidrule(lr){{{column}-{column + cell.span - 1}}}")
        column += cell.span
    return " ".join(rules)


def _escaped(text: str) -> str:
    return re.sub("|".join(map(re.escape, _LATEX)), lambda match: _LATEX[match.group()], text)


def _csv(records: Sequence[Mapping[str, Any]]) -> str:
    """One row per record; a record without some name has nothing there."""
    names = list(dict.fromkeys(name for record in records for name in record))
    text = io.StringIO(newline="")
    rows = csv.DictWriter(text, names, lineterminator="\n")
    rows.writeheader()
    rows.writerows({name: _csv_value(value) for name, value in record.items()} for record in records)
    return text.getvalue()


def _csv_value(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value
