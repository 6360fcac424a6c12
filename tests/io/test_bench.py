"""The benchmark of reading: honest files, figures of every repeat, results as JSON and Markdown."""

import json

import pytest
from io_files import everything

from torchtrack.bench.io import HEIGHT, TARGETS, WIDTH, measure, synthetic, write_events
from torchtrack.bench.results import Report, Result, as_markdown, machine
from torchtrack.bench.setup import Setup
from torchtrack.cli.main import main
from torchtrack.core.events import concatenate
from torchtrack.io import open_events


@pytest.mark.parametrize("name", [name for name in TARGETS if name not in ("aedat4", "csv", "npz", "dsec")])
def test_files_hold_the_events_that_are_measured(tmp_path, name):
    path = tmp_path / ("e.txt" if name == "davis" else "e.bin")
    write_events(path, name, 3000)
    expected = concatenate(synthetic(3000))
    batch = everything(open_events(path, WIDTH, HEIGHT))
    assert all(bool((getattr(batch, field) == getattr(expected, field)).all()) for field in ("x", "y", "t_us", "polarity"))


def test_every_format_is_measured():
    seen = []
    results = measure(Setup(repeats=2, events=2000, show=seen.append)).results
    assert seen == list(TARGETS)
    assert {result.name for result in results} >= {"evt2", "evt3", "dat", "dsec", "npz", "csv", "davis"}
    assert all(len(result.figures) == 2 and min(result.figures) > 0 for result in results)


def test_medians_and_quartiles_are_told():
    result = Result("evt3", "Mev/s", (10.0, 50.0, 30.0, 20.0, 40.0), 30.0)
    assert result.quartiles == (20.0, 30.0, 40.0)
    assert result.reached
    assert Result("x", "s", (1.0,)).quartiles == (1.0, 1.0, 1.0)
    assert "| evt3 | 30.0 Mev/s | 20.0 … 40.0 |  | ≥ 30 | reached |" in as_markdown(Report("io", "Reading", (result,)), machine())
    assert "| missed |" in as_markdown(Report("io", "Reading", (Result("evt3", "Mev/s", (1.0, 2.0), 30.0),)), machine())


def test_the_command_writes_json_and_markdown(tmp_path, capsys):
    assert main(["bench", "io", "-o", str(tmp_path), "--repeats", "1", "--events", "1000"]) == 0
    assert "# Reading events" in capsys.readouterr().out
    content = json.loads((tmp_path / "bench_io.json").read_text())
    assert {entry["name"] for entry in content["results"]} >= {"evt2", "evt3"}
    assert "processor" in (tmp_path / "bench_io.md").read_text()
    assert main(["bench", "io", "-o", str(tmp_path), "--repeats", "0"]) == 2
