"""Where the sequences of the paper's cells come from."""

from pathlib import Path

import pytest

from torchtrack.config.evaluate import CellConfig, EvaluateConfig
from torchtrack.config.load import load
from torchtrack.errors import ConfigError, MissingFileError
from torchtrack.eval.evaluate import plan
from torchtrack.eval.paper import check_cells
from torchtrack.eval.sources import cell_sequences
from torchtrack.io import read_sequence

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "evaluate"
SCENE = """
name: small
duration_s: 0.02
camera: {width: 64, height: 48, fx: 60, fy: 60}
objects: [{label: cube, shape: cube, motion: {position_m: [0, 0, 0.6], translation_amplitude_m: [0.05, 0.05, 0.05], frequency_hz: 2}}]
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(SCENE)
    return path


def test_a_source_is_taken_as_it_is(tmp_path):
    (tmp_path / "a.npz").touch()
    assert cell_sequences({"13": CellConfig(source=tmp_path / "a.npz")}, tmp_path, 1) == ({"13": tmp_path / "a.npz"}, ())
    with pytest.raises(MissingFileError, match="no sequence or folder at"):
        cell_sequences({"13": CellConfig(source=tmp_path / "b.npz")}, tmp_path, 1)


def test_scenes_are_simulated_once_and_one_that_fails_stops_no_other(scene, tmp_path):
    pytest.importorskip("numba", reason="the simulator needs the extra 'sim'")
    broken = {"name": "broken", "background": {"image": str(tmp_path / "none.png")}}
    cells = {"13": CellConfig(scene=scene), "14": CellConfig(scene=scene), "15": CellConfig(scene=scene, overrides=broken)}
    progress = []
    paths, failures = cell_sequences(cells, tmp_path / "cache", 1, lambda name, share: progress.append((name, share)))
    assert [path.stem for path in paths.values()] == ["small", "small", "broken"]
    assert read_sequence(paths["13"]).objects[0].label == "cube"
    assert [(failure.sequence, failure.method) for failure in failures] == [("broken", "simulation")]
    assert "none.png" in failures[0].reason and ("small", 1.0) in progress
    before = paths["13"].stat().st_mtime_ns
    assert cell_sequences({"13": CellConfig(scene=scene)}, tmp_path / "cache", 1) == ({"13": paths["13"]}, ())
    assert paths["13"].stat().st_mtime_ns == before


def test_wrong_scenes_are_told(scene, tmp_path):
    with pytest.raises(ConfigError, match="speedy"):
        cell_sequences({"13": CellConfig(scene=scene, overrides={"speedy": 2.0})}, tmp_path, 1)
    with pytest.raises(MissingFileError, match="no config file"):
        cell_sequences({"13": CellConfig(scene=tmp_path / "none.yaml")}, tmp_path, 1)
    with pytest.raises(ConfigError, match="two different scenes are called 'small'"):
        cell_sequences({"13": CellConfig(scene=scene), "14": CellConfig(scene=scene, overrides={"speed": 2.0})}, tmp_path, 1)


def test_every_sequence_is_planned_once_per_method(tmp_path):
    for name in "ab":
        (tmp_path / f"{name}.npz").touch()
    cells = {"13": {"source": str(tmp_path / "a.npz")}, "15": {"source": str(tmp_path / "a.npz")}}
    values = {"report": "paper", "cells": cells, "paths": [str(tmp_path / "b.npz")], "methods": {"default": {}, "line": {"preset": "line"}}}
    planned = plan(load(EvaluateConfig, None, values))
    assert [(job.path.stem, job.method) for job in planned.jobs] == [("b", "default"), ("b", "line"), ("a", "default"), ("a", "line")]
    assert planned.jobs[1].config.preset == "line"
    assert {name: path.stem for name, path in planned.cells.items()} == {"13": "a", "15": "a"}


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_settings_are_valid(path):
    config = load(EvaluateConfig, path)
    check_cells(config.cells)
    assert all(cell.scene is None or cell.scene.is_file() for cell in config.cells.values())
