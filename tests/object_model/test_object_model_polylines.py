"""Object models that are line segments and nothing else."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from torchtrack.core.limits import Limits, limits
from torchtrack.errors import LimitError, MissingFileError, ModelError, UnknownFormatError
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.polylines import as_polylines

SQUARE = [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0, 0, 0]]
LINE = [[0.02, 0.02, 0], [0.08, 0.08, 0]]


def assert_square_with_line(model: ObjectModel) -> None:
    expected = [[a, b] for a, b in pairwise(SQUARE)] + [LINE]
    torch.testing.assert_close(model.segments, torch.tensor(expected))
    torch.testing.assert_close(model.centre, torch.tensor([0.05, 0.05, 0]))
    assert model.diameter_m == pytest.approx(0.1 * 2**0.5)
    assert model.mesh is None
    assert model.edge_points.shape == model.edge_normals.shape == (0, 2, 3)
    assert model.edge_is_crease.shape == (0,)
    assert model.edge_is_crease.dtype == torch.bool
    for points in (model.texture_points, model.texture_tangents, model.texture_normals, model.surface_points, model.surface_normals):
        assert points.shape == (0, 3)


def test_from_lists():
    model = ObjectModel.from_polylines([SQUARE, LINE])
    assert model.name == "polylines"
    assert_square_with_line(model)


def test_from_an_array_of_segments():
    segments = np.random.default_rng(0).uniform(0, 0.1, (7, 2, 3))
    torch.testing.assert_close(ObjectModel.from_polylines(segments, name="sticks").segments, torch.tensor(segments, dtype=torch.float32))


@pytest.mark.parametrize(("stated", "given", "scale"), [("mm", "m", 1000), ("cm", "inch", 100), (None, "mm", 1000), (None, "m", 1)])
def test_json_and_its_unit(tmp_path: Path, stated: str | None, given: str, scale: float):
    lines = [(np.array(line) * scale).tolist() for line in (SQUARE, LINE)]
    (tmp_path / "page.json").write_text(json.dumps({"polylines": lines} | ({"unit": stated} if stated else {})))
    model = ObjectModel.from_polylines(tmp_path / "page.json", unit=given)
    assert model.name == "page"
    assert_square_with_line(model)
    assert_square_with_line(ObjectModel.from_file(tmp_path / "page.json", unit=given))


@pytest.mark.parametrize("square", ["l 1 2 3 4 1", "l -4 -3 -2 -1 -4", "l 1/1 2/1 3/1 4/1 1/1"])
def test_obj_lines(tmp_path: Path, square: str):
    text = f"# a page\no page\nv 0 0 0\nv 10 0 0\nv 10 10 0\nv 0 10 0\n{square}\n\nv 2 2 0\nv 8 8 0\nl 5 6\n"
    (tmp_path / "page.obj").write_text(text)
    assert_square_with_line(ObjectModel.from_polylines(tmp_path / "page.obj", unit="cm"))
    assert_square_with_line(ObjectModel.from_file(tmp_path / "page.obj", unit="cm"))


def test_segments_without_length_are_dropped():
    assert_square_with_line(ObjectModel.from_polylines([SQUARE[:2] + SQUARE[1:], LINE]))


def test_missing_and_unknown_files(tmp_path: Path):
    with pytest.raises(MissingFileError, match=r"page\.json' does not exist"):
        ObjectModel.from_polylines(tmp_path / "page.json")
    (tmp_path / "page.svg").write_text("<svg/>")
    with pytest.raises(UnknownFormatError, match=r"\.json, \.obj"):
        ObjectModel.from_polylines(tmp_path / "page.svg")


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"polylines": 3}', '{"polylines": [[["a", 0, 0], [0, 0, 0]]]}', '{"polylines": [[[0, 0], [0, 0, 0]]]}']
)
def test_json_that_is_not_understood(tmp_path: Path, text: str):
    (tmp_path / "page.json").write_text(text)
    with pytest.raises(ModelError, match=r'page\.json.*Expected is JSON such as \{"unit": "mm", "polylines"'):
        ObjectModel.from_polylines(tmp_path / "page.json")


def test_points_of_the_wrong_shape(tmp_path: Path):
    (tmp_path / "page.json").write_text('{"polylines": [[[0, 0, 0], [1, 0, 0]], [[0, 0, 0]]]}')
    with pytest.raises(ModelError, match=r"page\.json': polyline 1 must be two or more points.*got shape \[1, 3\]"):
        ObjectModel.from_polylines(tmp_path / "page.json")
    with pytest.raises(ModelError, match=r"polyline 0 .*got shape \[2, 2\]"):
        ObjectModel.from_polylines([[[0, 0], [1, 1]]])


def test_obj_line_to_a_vertex_that_is_not_there(tmp_path: Path):
    (tmp_path / "page.obj").write_text("v 0 0 0\nv 1 0 0\nl 1 3\n")
    with pytest.raises(ModelError, match=r'page\.obj\': line 3 \("l 1 3"\) names a vertex that is not there; 2 come before it'):
        ObjectModel.from_polylines(tmp_path / "page.obj")


@pytest.mark.parametrize("lines", [[], [[[0, 0, 0], [0, 0, 0]]]])
def test_nothing_to_track(lines: list):
    with pytest.raises(ModelError, match="no line segments"):
        ObjectModel.from_polylines(lines)


def test_same_checks_as_meshes(tmp_path: Path):
    with pytest.raises(ModelError, match=r"1 of 2 vertices of 'page' are not finite"):
        ObjectModel.from_polylines([[[0, 0, 0], [np.nan, 0, 0]]], name="page")
    with pytest.raises(ModelError, match=r"100 m across.*unit='mm' \(0\.1 m\)"):
        ObjectModel.from_polylines([[[0, 0, 0], [100, 0, 0]]], name="page")
    (tmp_path / "page.json").write_text('{"unit": "furlong", "polylines": [[[0, 0, 0], [1, 0, 0]]]}')
    with pytest.raises(ModelError, match=r"unknown unit 'furlong' for 'page'"):
        ObjectModel.from_polylines(tmp_path / "page.json")


HOSTILE = ["[" * 100_000, '{"polylines": ' + "[" * 100_000, '{"polylines": [[[1e999, 0, 0], [0, 0, 0]]]}', "\ud800"]
HOSTILE += ['{"polylines": [[[1' + "0" * 400 + ", 0, 0], [0, 0, 0]]]}", '{"polylines": {"a": 1}}', '{"polylines": "abc"}', '{"polylines": [null]}']
HOSTILE += ['{"polylines": [[[0, 0, 0], [0, 0]]]}', '{"polylines": [[[{}, 0, 0], [1, 0, 0]]]}']


@pytest.mark.parametrize("text", HOSTILE, ids=range(10))
def test_hostile_json(tmp_path: Path, text: str):
    (tmp_path / "page.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(ModelError, match="page"):
        ObjectModel.from_file(tmp_path / "page.json")


def test_points_are_limited(tmp_path: Path):
    (tmp_path / "page.json").write_text(json.dumps({"polylines": [SQUARE]}))
    with limits(Limits(vertices=4)), pytest.raises(LimitError, match=r"limits\.vertices"):
        ObjectModel.from_file(tmp_path / "page.json")


def test_lines_that_go_on_and_end_in_comments(tmp_path: Path):
    (tmp_path / "page.obj").write_text(
        "v 0 0 0\nv 0.1 0 0 # a corner\nv 0.1 0.1 0\nv 0 0.1 0\nl 1 2 \\\n 3 4 1\nv 0.02 0.02 0\nv 0.08 0.08 0\nl 5 6\n"
    )
    assert_square_with_line(ObjectModel.from_file(tmp_path / "page.obj"))


def test_lists_of_wrong_types():
    with pytest.raises(ModelError, match="not made of points of three numbers"):
        as_polylines([[[0, 0, 0], ["a", 0, 0]]])
