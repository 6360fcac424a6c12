"""Tables 1, 2 and 3 in the paper's layout: its own figures (``paper_tables.yaml``), and ours for the same cells beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from statistics import fmean
from typing import Any

import yaml

from torchtrack.config.evaluate import CellConfig
from torchtrack.errors import ConfigError
from torchtrack.eval.grid import Cell, Grid, Report
from torchtrack.eval.results import Evaluation, ObjectResult

# What the paper calls the methods that it compares; others of ours follow after them.
_NAMES = {"line": "Line-Based", "ls": "LS-Based", "nns": "NNS-Based", "paper": "Ours"}
_UNITS = "(δR in °, δT in cm)"
_LOST_MARK, _LOST_SHARE = "†", 0.1
_NOTES = (
    "Published figures are the paper's own, on its own data; the others are this package's, on its own sequences.",
    f"{_LOST_MARK} lost in {100 * _LOST_SHARE:.0f} % of the windows or more. - not made for such objects. Bold: the best of each kind.",
    "Of surfaces of revolution, such as a vase, turns about the axis do not count as errors in ours: nothing shows them.",
)
# Conditions of simulated sequences are part of a cell's name; real ones have one cell, and the condition says its kind.
_REAL_TABLE = 3


@dataclass(frozen=True)
class PaperCell:
    """One cell of the paper's tables: a sequence under a condition."""

    table: int
    sequence: str
    condition: str
    figures: Mapping[str, tuple[float, float]]

    @property
    def name(self) -> str:
        """As in ``cells`` of the settings: ``01 slow``, ``13``."""
        return self.sequence if self.table == _REAL_TABLE else f"{self.sequence} {self.condition}"


@dataclass(frozen=True)
class PaperTable:
    """One table: its caption, its blocks of cells below one another, and the paper's methods in it."""

    number: int
    caption: str
    blocks: tuple[tuple[PaperCell, ...], ...]
    methods: tuple[str, ...]


@cache
def paper_tables() -> tuple[PaperTable, ...]:
    """The paper's tables with its own figures: rotation (°) and translation (cm) by the paper's name of each method."""
    text = files("torchtrack.eval").joinpath("paper_tables.yaml").read_text(encoding="utf-8")
    return tuple(_table(values) for values in yaml.safe_load(text))


def _table(values: Mapping[str, Any]) -> PaperTable:
    blocks = tuple(tuple(cell for pair in block.items() for cell in _cells(values, *pair)) for block in values["blocks"])
    return PaperTable(values["number"], values["caption"], blocks, tuple(values["figures"]))


def _cells(values: Mapping[str, Any], sequence: str, conditions: Sequence[str]) -> list[PaperCell]:
    known = {method: figures[sequence] for method, figures in values["figures"].items() if figures[sequence]}
    return [
        PaperCell(values["number"], sequence, condition, {method: (pairs[place][0], pairs[place][1]) for method, pairs in known.items()})
        for place, condition in enumerate(conditions)
    ]


def check_cells(cells: Mapping[str, CellConfig]) -> None:
    """Raise :class:`ConfigError` where a cell is none of the paper's."""
    known = [cell.name for table in paper_tables() for block in table.blocks for cell in block]
    if unknown := [name for name in cells if name not in known]:
        raise ConfigError(f"cells: the paper's tables have no {', '.join(map(repr, unknown))}. Their cells are {', '.join(known)}.")


@dataclass(frozen=True)
class _Entry:
    """One figure: by whom, rotation (°) and translation (cm), or a text in their place."""

    rotation_deg: float | None = None
    translation_cm: float | None = None
    lost_fraction: float | None = None
    text: str = ""


@dataclass(frozen=True)
class _Row:
    """One row of a table: its label, the method, whether its figures are the paper's own, and an entry per cell name."""

    label: str
    method: str
    from_paper: bool
    entries: Mapping[str, _Entry]


def paper_report(evaluation: Evaluation, cells: Mapping[str, CellConfig], paths: Mapping[str, Path], methods: Sequence[str]) -> Report:
    """The paper's tables with our figures beside its own, and the means of each method.

    Our cells are empty where nothing was measured, and ``-`` where the method is not made for the object, as in the
    paper. The best figures of each column are bold, among the paper's and among ours.

    Args:
        cells: which object counts, by cell.
        paths: the sequence measured, by cell.
        methods: labels, of which ``line``, ``ls``, ``nns`` and ``paper`` stand beside the paper's own figures.
    """
    tables = paper_tables()
    measured = {method: {name: _measured(evaluation, method, path.stem, cells[name].object) for name, path in paths.items()} for method in methods}
    rows = {table.number: _rows(table, measured) for table in tables}
    grids = [_grid(table, block, rows[table.number], paths) for table in tables for block in table.blocks]
    every = [cell for table in tables for block in table.blocks for cell in block]
    records = [_record(cell, row, paths) for cell in every for row in rows[cell.table] if _has_figures(row.entries.get(cell.name))]
    return Report((*grids, _means(tables, rows, set(paths))), tuple(records))


def _measured(evaluation: Evaluation, method: str, sequence: str, label: str | None) -> _Entry:
    """Our figure for a cell: that of the object named, else of the first."""
    results: list[ObjectResult] = [result for result in evaluation.results if (result.method, result.sequence) == (method, sequence)]
    results = [result for result in results if label in (None, result.object)]
    unfit = [entry for entry in evaluation.not_applicable if (entry.method, entry.sequence) == (method, sequence) and label in (None, entry.object)]
    if results:
        metrics = results[0].metrics
        return _Entry(metrics.mean_rotation_deg, metrics.mean_translation_cm, metrics.lost_fraction)
    return _Entry(text="-" if unfit else "failed")


def _rows(table: PaperTable, measured: Mapping[str, Mapping[str, _Entry]]) -> list[_Row]:
    """The paper's methods, each with ours of the same kind below it, then our others."""
    cells = [cell for block in table.blocks for cell in block]
    rows = []
    for method in dict.fromkeys([*_NAMES, *measured]):
        name = _NAMES.get(method)
        if name in table.methods:
            figures = {cell.name: _Entry(*cell.figures[name]) if name in cell.figures else _Entry(text="-") for cell in cells}
            rows.append(_Row(f"{name}, published", name, True, figures))
        if method in measured:
            rows.append(_Row(method, method, False, measured[method]))
    return rows


def _grid(table: PaperTable, block: Sequence[PaperCell], rows: Sequence[_Row], paths: Mapping[str, Path]) -> Grid:
    sequences = {cell.sequence: 2 * sum(other.sequence == cell.sequence for other in block) for cell in block}
    header = (
        (Cell("Sequence"), *(Cell(sequence, span) for sequence, span in sequences.items())),
        (Cell(""), *(Cell(cell.condition.capitalize(), 2) for cell in block)),
        (Cell("Method"), *(Cell(symbol) for _ in block for symbol in ("δR", "δT"))),
    )
    first, last = block[0].sequence, block[-1].sequence
    title = f"Table {table.number}. {table.caption} {_UNITS}, sequences {first} to {last}."
    measured = ", ".join(f"{cell.name}: {paths[cell.name].stem}" for cell in block if cell.name in paths)
    body = tuple(_grid_row(row, block, _best(rows, row.from_paper, block)) for row in rows)
    return Grid(title, header, body, (f"Measured on {measured}.",) if measured else ("Nothing was measured for these.",))


def _best(rows: Sequence[_Row], from_paper: bool, block: Sequence[PaperCell]) -> dict[str, tuple[float, float]]:
    """The smallest rotation and translation of each cell, among the paper's figures or ours."""
    best = {}
    for cell in block:
        entries = [row.entries.get(cell.name, _Entry()) for row in rows if row.from_paper == from_paper]
        rotations = [entry.rotation_deg for entry in entries if entry.rotation_deg is not None]
        translations = [entry.translation_cm for entry in entries if entry.translation_cm is not None]
        if rotations:
            best[cell.name] = (min(rotations), min(translations))
    return best


def _grid_row(row: _Row, block: Sequence[PaperCell], best: Mapping[str, tuple[float, float]]) -> tuple[Cell, ...]:
    cells = [Cell(row.label)]
    for cell in block:
        entry = row.entries.get(cell.name, _Entry())
        if entry.rotation_deg is None or entry.translation_cm is None:
            cells += [Cell(entry.text), Cell(entry.text)]
            continue
        figure = "{:.2f}".format if row.from_paper else _figure
        mark = _LOST_MARK if (entry.lost_fraction or 0) >= _LOST_SHARE else ""
        rotation, translation = best[cell.name]
        cells.append(Cell(figure(entry.rotation_deg) + mark, bold=entry.rotation_deg == rotation))
        cells.append(Cell(figure(entry.translation_cm) + mark, bold=entry.translation_cm == translation))
    return tuple(cells)


def _figure(value: float) -> str:
    """Two decimals as in the paper; three where these would say little."""
    return f"{value:.2f}" if value >= 1 else f"{value:.3f}"


def _means(tables: Sequence[PaperTable], rows: Mapping[int, Sequence[_Row]], measured: set[str]) -> Grid:
    """Mean of each method over those cells of each table that it has figures for, and were measured by us."""
    labels = dict.fromkeys(row.label for table in tables for row in rows[table.number])
    header = (
        (Cell(""), *(Cell(f"Table {table.number}", 3) for table in tables)),
        (Cell("Method"), *(Cell(name) for _ in tables for name in ("δR", "δT", "cells"))),
    )
    body = [(Cell(label), *(cell for table in tables for cell in _mean_cells(table, rows[table.number], label, measured))) for label in labels]
    return Grid(f"Means over the cells that were measured {_UNITS}.", header, tuple(body), _NOTES)


def _mean_cells(table: PaperTable, rows: Sequence[_Row], label: str, measured: set[str]) -> list[Cell]:
    names = [cell.name for block in table.blocks for cell in block if cell.name in measured]
    entries = [row.entries[name] for row in rows if row.label == label for name in names if name in row.entries]
    rotations = [entry.rotation_deg for entry in entries if entry.rotation_deg is not None]
    translations = [entry.translation_cm for entry in entries if entry.translation_cm is not None]
    if not rotations:
        return [Cell("-"), Cell("-"), Cell("0")]
    return [Cell(_figure(fmean(rotations))), Cell(_figure(fmean(translations))), Cell(str(len(rotations)))]


def _has_figures(entry: _Entry | None) -> bool:
    return entry is not None and entry.rotation_deg is not None


def _record(cell: PaperCell, row: _Row, paths: Mapping[str, Path]) -> dict[str, Any]:
    entry = row.entries[cell.name]
    return {
        "table": cell.table,
        "sequence": cell.sequence,
        "condition": cell.condition,
        "method": row.method,
        "source": "paper" if row.from_paper else paths[cell.name].stem,
        "rotation_deg": entry.rotation_deg,
        "translation_cm": entry.translation_cm,
        "lost_fraction": entry.lost_fraction,
    }
