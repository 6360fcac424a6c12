"""The paper's tables and the compact report, made of results that are known."""

from pathlib import Path
from statistics import fmean

import pytest
import torch

from torchtrack.config.evaluate import CellConfig, EvaluateConfig
from torchtrack.config.load import load
from torchtrack.errors import ConfigError
from torchtrack.eval.compact import compact_report
from torchtrack.eval.grid import headings
from torchtrack.eval.paper import check_cells, paper_report, paper_tables
from torchtrack.eval.results import Evaluation, Failure, NotApplicable, ObjectResult
from torchtrack.run.metrics import PoseErrors, summarise


def result(method, sequence="cube_slow", label="cube", rotation_deg=1.0, translation_cm=0.5, step_ms=10.0):
    """Errors of two windows, the second twice as large as the first, with the given mean."""
    pattern = torch.tensor([2 / 3, 4 / 3], dtype=torch.float64)
    errors = PoseErrors(torch.tensor([0, 60_000]), rotation_deg * pattern, translation_cm * pattern)
    return ObjectResult(sequence, label, method, errors, summarise(errors), {"TRACKING": 2}, step_ms)


def evaluation(*results, not_applicable=(), failures=()):
    return Evaluation(results, tuple(not_applicable), tuple(failures))


def texts(grid):
    """Label of each row to its entries by heading."""
    names = headings(grid)[1:]
    return {row[0].text: dict(zip(names, (cell.text for cell in row[1:]), strict=True)) for row in grid.rows}


# ---- the paper's tables


def cells_of_paper():
    return [cell for table in paper_tables() for block in table.blocks for cell in block]


def test_the_papers_figures_are_all_there():
    cells = cells_of_paper()
    assert len(cells) == 35 == len({cell.name for cell in cells})
    ours = [cell.figures["Ours"] for cell in cells]
    assert (fmean(r for r, _ in ours), fmean(t for _, t in ours)) == pytest.approx((2.3, 6.0), abs=0.05)
    line = [cell.figures["Line-Based"] for cell in cells if cell.table == 3 and "Line-Based" in cell.figures]
    assert line == [(1.16, 2.99), (1.44, 3.81), (1.35, 3.94), (3.02, 6.58)]
    assert [cell.name for cell in cells if "Line-Based" not in cell.figures and cell.table == 3] == ["17"]


def test_cells_are_named_as_in_the_paper():
    names = [cell.name for cell in cells_of_paper()]
    assert names[:3] == ["01 slow", "01 fast", "02 normal"]
    assert names[12:15] == ["07 original", "07 messy", "07 occlusion"]
    assert names[-5:] == ["13", "14", "15", "16", "17"]
    check_cells({"01 slow": CellConfig(source="a.npz"), "17": CellConfig(source="a.npz")})
    with pytest.raises(ConfigError, match=r"no '01 normal', '99'. Their cells are 01 slow, 01 fast"):
        check_cells({name: CellConfig(source="a.npz") for name in ("01 normal", "99", "17")})


def report_of_three():
    cells = {
        "01 slow": CellConfig(source="cube_slow.npz"),
        "17": CellConfig(source="many.npz", object="duck"),
        "02 fast": CellConfig(source="bad.npz"),
    }
    measured = evaluation(
        result("line"),
        result("default", rotation_deg=0.1234, translation_cm=0.0456),
        result("paper", rotation_deg=80.0),
        result("default", "many", "cube"),
        result("default", "many", "duck", rotation_deg=3.0),
        not_applicable=[NotApplicable("many", "duck", "line", "curved")],
        failures=[Failure("bad", method, "broken") for method in ("line", "paper", "default")],
    )
    paths = {name: Path(f"/data/{cell.source.name}") for name, cell in cells.items()}
    return paper_report(measured, cells, paths, ("line", "paper", "default"))


def test_our_figures_stand_beside_the_papers():
    first = report_of_three().grids[0]
    table = texts(first)
    assert list(table) == ["Line-Based, published", "line", "LS-Based, published", "NNS-Based, published", "Ours, published", "paper", "default"]
    slow = {label: (row["01 Slow δR"], row["01 Slow δT"]) for label, row in table.items()}
    assert slow["Ours, published"] == ("2.24", "3.42")
    assert slow["line"] == ("1.00", "0.500")
    assert slow["default"] == ("0.123", "0.046")
    # Lost in every other window: the second is beyond 10°.
    assert slow["paper"] == ("80.00†", "0.500†")
    assert table["default"]["01 Fast δR"] == ""
    assert table["default"]["02 Fast δR"] == "failed"
    assert first.notes == ("Measured on 01 slow: cube_slow, 02 fast: bad.",)
    bold = {row[0].text for row in first.rows if row[1].bold}
    assert bold == {"LS-Based, published", "default"}


def test_the_object_that_is_named_counts_and_lines_have_none_of_curves():
    table = texts(report_of_three().grids[4])
    assert table["default"]["17 Nonplanar curve δR"] == "3.00"
    assert table["line"]["17 Nonplanar curve δR"] == table["Line-Based, published"]["17 Nonplanar curve δT"] == "-"
    assert table["Ours, published"]["17 Nonplanar curve δT"] == "7.66"


def test_means_are_over_the_cells_that_were_measured():
    report = report_of_three()
    means = texts(report.grids[5])
    assert len(report.grids) == 6
    assert means["default"] == {
        "Table 1 δR": "0.123",
        "Table 1 δT": "0.046",
        "Table 1 cells": "1",
        "Table 2 δR": "-",
        "Table 2 δT": "-",
        "Table 2 cells": "0",
        "Table 3 δR": "3.00",
        "Table 3 δT": "0.500",
        "Table 3 cells": "1",
    }
    assert means["Ours, published"]["Table 1 cells"] == "2"


def test_records_say_where_each_figure_is_from():
    records = report_of_three().records
    assert sum(record["source"] == "paper" for record in records) == 12 * 4 + 18 * 2 + 5 * 4 - 2
    assert {(record["sequence"], record["method"], record["source"]) for record in records if record["source"] != "paper"} == {
        *(("01", method, "cube_slow") for method in ("line", "paper", "default")),
        ("17", "default", "many"),
    }


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"report": "paper"}, "cells and report: paper belong together"),
        ({"cells": {"13": {"source": "a.npz"}}}, "cells and report: paper belong together"),
        ({"report": "paper", "cells": {"13": {}}}, "exactly one of source and scene"),
        ({"report": "paper", "cells": {"13": {"source": "a.npz", "scene": "a.yaml"}}}, "exactly one of source and scene"),
        ({"report": "paper", "cells": {"13": {"source": "a.npz", "overrides": {"speed": 2}}}}, "overrides are for a scene"),
        ({"report": "paper", "cells": {"first": {"source": "a.npz"}}}, "cells.first"),
    ],
)
def test_settings_that_do_not_fit_a_report(values, expected):
    with pytest.raises(ConfigError, match=expected):
        load(EvaluateConfig, None, values)


# ---- the compact report


def test_compact_report_has_a_row_per_method_and_the_change_to_the_first():
    measured = evaluation(
        *(result("a"), result("a", "two", "left", 0.2, 0.02, 30.0), result("a", "two", "right", 0.4, 0.04)),
        *(result("b", rotation_deg=1.5), result("b", "two", "left", 11.0, 0.02, 20.0)),
        not_applicable=[NotApplicable("two", "right", "b", "curved")],
    )
    report = compact_report(measured, ("a", "b"))
    (grid,) = report.grids
    assert texts(grid) == {
        "a": {
            "cube_slow": "1.00 / 5.00",
            "two: left": "0.20 / 0.20",
            "two: right": "0.40 / 0.40",
            "mean": "0.60 / 2.60",
            "change": "",
            "lost": "0.0 %",
            "peak": "1.3",
            "step": "20.0 ms",
        },
        "b": {
            "cube_slow": "1.50 / 5.00",
            "two: left": "11.00 / 0.20 (50 % lost)",
            "two: right": "-",
            "mean": "6.25 / 2.60",
            "change": "+5.650 / +0.00",
            "lost": "25.0 %",
            "peak": "1.3",
            "step": "15.0 ms",
        },
    }
    assert grid.notes == ("Mean, change, lost and step: over the 2 of 3 objects that every method tracked; change: to a.",)
    assert len(report.records) == 5
    assert report.records[0]["windows_tracking"] == 2


def test_compact_report_of_nothing_in_common():
    (grid,) = compact_report(evaluation(result("a"), failures=[Failure("cube_slow", "b", "broken")]), ("a", "b")).grids
    assert texts(grid)["b"]["cube_slow"] == "-"
    assert {texts(grid)[method][name] for method in "ab" for name in ("mean", "change", "lost", "peak", "step")} == {"-"}
