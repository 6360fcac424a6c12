"""Models that are 3D line segments: printed patterns, books, markers, anything drawn on a plane.

Two formats, both plain text:

- JSON: ``{"unit": "mm", "polylines": [[[x, y, z], [x, y, z], ...], ...]}``. A closed line repeats its first point;
  ``unit`` may be left out.
- OBJ with line records: ``v x y z`` and ``l 1 2 3``.
"""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from torchtrack.core.limits import check_limit
from torchtrack.errors import LimitError, ModelError
from torchtrack.object_model.loading import check_file
from torchtrack.object_model.obj import joined_lines

POLYLINE_SUFFIXES = (".json", ".obj")

Polylines = list[np.ndarray]
_EXPECTED = ' Expected is JSON such as {"unit": "mm", "polylines": [[[0, 0, 0], [50, 0, 0]]]}, or an OBJ file with "v" and "l" records.'


def read_polylines(path: str | Path) -> tuple[Polylines, str | None]:
    """The polylines ``[n, 3]`` of a file, and the unit that it states, if it does.

    Raises:
        MissingFileError, UnknownFormatError: if the file is not there, or is of another kind.
        ModelError: if it cannot be understood.
    """
    path = check_file(path, POLYLINE_SUFFIXES)
    try:
        if path.suffix.lower() == ".obj":
            return _obj_lines(path.read_text(encoding="latin-1")), None
        text = path.read_bytes()
        # Of a point there are one bracket and three commas; a hostile file has nothing else.
        check_limit("vertices", max(text.count(b"["), text.count(b",") // 3), path)
        content = json.loads(text.decode("utf-8-sig"))
        return as_polylines(list(content["polylines"])), str(content["unit"]) if "unit" in content else None
    except ModelError as error:
        raise ModelError(f"'{path}': {error}{_EXPECTED if path.suffix.lower() == '.json' else ''}") from error
    except LimitError:
        raise
    except (ValueError, KeyError, IndexError, TypeError, OverflowError, RecursionError, MemoryError, OSError) as error:
        raise ModelError(f"cannot read polylines from '{path}' ({type(error).__name__}: {error}).{_EXPECTED}") from error


def has_obj_lines(path: Path) -> bool:
    """Whether an OBJ file has lines and no faces."""
    data = path.read_bytes()
    return re.search(rb"^[ \t]*l[ \t]", data, re.MULTILINE) is not None and re.search(rb"^[ \t]*f[ \t]", data, re.MULTILINE) is None


def _obj_lines(text: str) -> Polylines:
    """The ``l`` records of an OBJ file; indices start at 1, negative ones count from the newest vertex."""
    vertices: list[list[float]] = []
    lines = []
    for number, line in joined_lines(text):
        kind, *values = line.split() or [""]
        if kind == "v":
            vertices.append([float(value) for value in values[:3]])
        elif kind == "l":
            indices = [int(value.split("/")[0]) for value in values]
            indices = [index - 1 if index > 0 else len(vertices) + index for index in indices]
            if not all(0 <= index < len(vertices) for index in indices):
                raise ModelError(f'line {number} ("{line}") names a vertex that is not there; {len(vertices)} come before it.')
            lines.append([vertices[index] for index in indices])
    return as_polylines(lines)


def as_polylines(lines: Iterable[Any]) -> Polylines:
    """Lists of points, from anywhere, as arrays ``[n, 3]``.

    Raises:
        ModelError: if a line is not made of two or more points of three numbers.
    """
    try:
        arrays = [np.asarray(line, dtype=np.float64) for line in lines]
    except (ValueError, TypeError, OverflowError) as error:
        raise ModelError(f"a polyline is not made of points of three numbers [n, 3] ({error}).") from error
    for number, line in enumerate(arrays):
        if line.ndim != 2 or line.shape[1] != 3 or len(line) < 2:
            raise ModelError(f"polyline {number} must be two or more points of three numbers [n, 3], got shape {list(line.shape)}.")
    return arrays


def segments_of(polylines: Polylines) -> np.ndarray:
    """The segments ``[L, 2, 3]`` of polylines, without those of no length."""
    if not polylines:
        return np.zeros((0, 2, 3))
    segments = np.concatenate([np.stack([line[:-1], line[1:]], 1) for line in polylines])
    # A NaN is kept here: the check of the coordinates says more than a segment that is gone.
    return segments[~(segments[:, 0] == segments[:, 1]).all(1)]
