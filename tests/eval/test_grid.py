"""Tables as Markdown, LaTeX, CSV and JSON."""

import csv
import json

import pytest

from torchtrack.eval.grid import Cell, Grid, Report, headings, latex, markdown

GRID = Grid(
    "Errors (δR in °)",
    ((Cell("Sequence"), Cell("01", 2), Cell("02")), (Cell("Method"), Cell("slow"), Cell("fast"), Cell(""))),
    ((Cell("a_b"), Cell("1.0", bold=True), Cell("10 %"), Cell("-")), (Cell("c"), Cell("2.0†"), Cell("", bold=True), Cell("3"))),
    ("A note.",),
)


def test_headings_are_read_from_above():
    assert headings(GRID) == ["Method", "01 slow", "01 fast", "02"]


def test_markdown_is_aligned_and_has_a_column_per_heading():
    title, _, *table, _, note = markdown(GRID).splitlines()
    assert (title, note) == ("**Errors (δR in °)**", "A note.")
    assert len(table) == 4
    assert len({len(line) for line in table}) == 1
    assert [[entry.strip() for entry in line.split("|")[1:-1]] for line in (table[0], *table[2:])] == [
        ["Method", "01 slow", "01 fast", "02"],
        ["a_b", "**1.0**", "10 %", "-"],
        ["c", "2.0†", "", "3"],
    ]
    assert [set(rule) for rule in table[1].split("|")[1:-1]] == [{"-"}, {"-", ":"}, {"-", ":"}, {"-", ":"}]


def test_latex_has_spans_rules_and_escapes():
    lines = latex(GRID).splitlines()
    assert r"\begin{tabular}{lccc}" in lines
    assert r"Sequence & \multicolumn{2}{c}{01} & 02 \\" in lines
    assert r"\cmidrule(lr){2-3}" in lines
    assert r"a\_b & \textbf{1.0} & 10 \% & - \\" in lines
    assert r"c & 2.0$^\dagger$ &  & 3 \\" in lines
    assert r"\caption{Errors ($\delta$R in $^\circ$)}" in lines
    assert lines[0] == r"\begin{table*}[htbp]" and lines[-1] == r"\end{table*}"


def test_report_is_written_in_four_forms(tmp_path):
    records = ({"method": "a", "error": 0.123456789}, {"method": "b", "error": float("nan"), "windows": 3})
    Report((GRID, GRID), records).write(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tables.csv", "tables.json", "tables.md", "tables.tex"]
    assert (tmp_path / "tables.md").read_text().count(GRID.title) == 2
    assert (tmp_path / "tables.tex").read_text().count(r"\begin{table*}") == 2
    assert json.loads((tmp_path / "tables.json").read_text()) == [
        {"method": "a", "error": pytest.approx(0.123456789)},
        {"method": "b", "error": None, "windows": 3},
    ]
    rows = list(csv.DictReader((tmp_path / "tables.csv").read_text().splitlines()))
    assert rows == [{"method": "a", "error": "0.123457", "windows": ""}, {"method": "b", "error": "nan", "windows": "3"}]
