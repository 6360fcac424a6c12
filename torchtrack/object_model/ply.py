"""PLY: its header held against its size, and binary files whose faces have different numbers of corners, which trimesh does not read."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchtrack.core.limits import check_limit
from torchtrack.errors import ModelError, TorchtrackError
from torchtrack.object_model.side_files import MeshText, SideFiles

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"}
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
_CORNERS = ("vertex_index", "vertex_indices")
_LONGEST_HEADER = 1 << 16


@dataclass(frozen=True)
class _Property:
    """A value of a row: its ``dtype``, and that of its ``count`` if it is a list."""

    name: str
    dtype: np.dtype
    count: np.dtype | None


@dataclass(frozen=True)
class _Element:
    """A table of a PLY file."""

    name: str
    rows: int
    properties: tuple[_Property, ...]

    @property
    def least_bytes(self) -> int:
        """The least that a row can take."""
        return sum((prop.count or prop.dtype).itemsize for prop in self.properties)


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file: whether it is text, in which order bytes are, its tables, the texture it names, and its length."""

    is_ascii: bool
    order: str
    elements: tuple[_Element, ...]
    texture: str | None
    length: int


def read_ply(path: Path) -> MeshText:
    """A PLY file as trimesh reads it.

    Raises:
        ModelError: if it is damaged; says where.
        LimitError: if it declares more faces or vertices than the limits.
    """
    data = path.read_bytes()
    header = _header(path, data)
    for element in header.elements:
        if element.name in ("face", "vertex"):
            check_limit("faces" if element.name == "face" else "vertices", element.rows, path)
    if any(element.name == "tristrips" and element.rows for element in header.elements):
        raise ModelError(f"'{path}' has triangle strips ('element tristrips'), which are not read. Export it with triangles ('element face').")
    body = len(data) - header.length
    least = sum(element.rows * (1 if header.is_ascii else element.least_bytes) for element in header.elements)
    if least > body:
        raise _damaged(path, f"its header declares {_declared(header)}, at least {least} bytes, and {body} follow it: it was cut short")
    if header.is_ascii:
        _check_rows(path, data, header)
    else:
        try:
            data = _with_even_faces(path, data, header)
        except TorchtrackError:
            raise
        except (ValueError, KeyError, IndexError, TypeError, OverflowError) as error:
            raise _damaged(path, f"its tables do not fit its header ({error})") from error
    images = {"": header.texture} if header.texture else {}
    return MeshText(data, "ply", SideFiles(path), tuple(images.values()), images)


def _damaged(path: Path, why: str) -> ModelError:
    return ModelError(f"cannot read '{path}' as a PLY mesh: {why}. Copy it again, or export it again.")


def _declared(header: PlyHeader) -> str:
    return ", ".join(f"{element.rows} of '{element.name}'" for element in header.elements)


def _header(path: Path, data: bytes) -> PlyHeader:
    end = re.search(rb"^end_header[ \t]*\r?(?:\n|\r)", data[:_LONGEST_HEADER], re.MULTILINE)
    if not data.startswith(b"ply") or end is None:
        raise _damaged(path, "it has no header from 'ply' to 'end_header'")
    lines = [line.split() for line in data[: end.start()].decode("latin-1").splitlines()[1:] if line.strip()]
    texture = re.search(r"^comment[ \t]+TextureFile[ \t]+(\S[^\n]*)$", data[: end.start()].decode("latin-1"), re.MULTILINE | re.IGNORECASE)
    kind = next((line[1] for line in lines if line[0] == "format" and len(line) > 1), "")
    order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}.get(kind)
    if order is None:
        raise _damaged(path, f"its format is '{kind}', expected ascii, binary_little_endian or binary_big_endian")
    try:
        elements = _elements([line for line in lines if line[0] in ("element", "property")], order)
    except (ValueError, KeyError, IndexError) as error:
        raise _damaged(path, f"its header is wrong ({type(error).__name__}: {error})") from error
    return PlyHeader(kind == "ascii", order, elements, texture.group(1).strip() if texture else None, end.end())


def _elements(lines: list[list[str]], order: str) -> tuple[_Element, ...]:
    elements: list[_Element] = []
    for kind, *words in lines:
        if kind == "element":
            elements.append(_Element(words[0], int(words[1]), ()))
            if elements[-1].rows < 0:
                raise ValueError(f"'{words[0]}' has {words[1]} rows")
            continue
        count = np.dtype(order + _TYPES[words[1]]) if words[0] == "list" else None
        prop = _Property(words[-1], np.dtype(order + _TYPES[words[-2]]), count)
        last = elements.pop()
        elements.append(_Element(last.name, last.rows, (*last.properties, prop)))
    return tuple(elements)


def _check_rows(path: Path, data: bytes, header: PlyHeader) -> None:
    """Every row of a text file is there."""
    rows = sum(element.rows for element in header.elements)
    lines = data[header.length :].splitlines()
    if len(lines) < rows:
        raise _damaged(path, f"its header declares {_declared(header)}, and {len(lines)} lines follow it: it was cut short")
    start = 0
    for element in header.elements:
        if element.name == "face" and element.properties and element.properties[0].count is not None:
            for row, line in enumerate(lines[start : start + element.rows]):
                count, *numbers = line.split() or [b"nothing"]
                if not count.isdigit() or int(count) > len(numbers):
                    raise _damaged(path, f"face {row} says that it has '{count.decode('latin-1')}' corners, and {len(numbers)} numbers follow")
        start += element.rows


def _with_even_faces(path: Path, data: bytes, header: PlyHeader) -> bytes:
    """The file as it is, if all rows of each list have the same length; else with its faces divided into triangles."""
    start, tables = header.length, {}
    for element in header.elements:
        dtype = _even_row(element, data, start)
        stop = start + element.rows * dtype.itemsize
        table = np.frombuffer(data[start:stop], dtype=dtype) if stop <= len(data) else None
        even = table is not None and all(
            (table[f"{prop.name} count"] == table[f"{prop.name} count"][:1]).all() for prop in element.properties if prop.count
        )
        if not even:
            break
        tables[element.name] = start, stop
        start = stop
    else:
        widths = {prop.name: prop for element in header.elements for prop in element.properties if element.name == "face" and prop.count}
        if start == len(data) and widths is not None:
            return data
        return data[:start]
    if element.name != "face":
        raise _damaged(path, f"the rows of '{element.name}' do not fit the file's length")
    return _triangulated(path, data, header, tables.get("vertex"), start)


def _even_row(element: _Element, data: bytes, start: int) -> np.dtype:
    """The row of a table, if all were like the first."""
    fields: list[tuple[str, object] | tuple[str, object, tuple[int]]] = []
    at = start
    for prop in element.properties:
        if prop.count is None:
            fields.append((prop.name, prop.dtype))
            at += prop.dtype.itemsize
            continue
        count = _number(data, at, prop.count) if element.rows else 0
        fields += [(f"{prop.name} count", prop.count), (prop.name, prop.dtype, (count,))]
        at += prop.count.itemsize + count * prop.dtype.itemsize
    return np.dtype(fields)


def _number(data: bytes, start: int, dtype: np.dtype) -> int:
    """A count; zero beyond the end, and no more than the file could hold."""
    word = data[start : start + dtype.itemsize]
    return min(max(int(np.frombuffer(word, dtype=dtype)[0]), 0), len(data)) if len(word) == dtype.itemsize else 0


def _triangulated(path: Path, data: bytes, header: PlyHeader, vertices: tuple[int, int] | None, start: int) -> bytes:
    """The vertices as they are, and the faces as fans of triangles, with their texture coordinates."""
    face = next(element for element in header.elements if element.name == "face")
    if vertices is None:
        raise _damaged(path, "its faces come before its vertices")
    triangles: list[tuple[int, int, int]] = []
    uvs: list[list[float]] = []
    at = start
    for row in range(face.rows):
        corners, uv, at = _face_row(data, at, face)
        if at > len(data):
            raise _damaged(path, f"it ends within face {row} of {face.rows}: it was cut short, or a number of corners is wrong")
        for k in range(1, len(corners) - 1):
            triangles.append((corners[0], corners[k], corners[k + 1]))
            uvs += [[*uv[:2], *uv[2 * k : 2 * k + 4]]] if len(uv) == 2 * len(corners) else []
    lists = [("vertex_indices", "i4", np.array(triangles).reshape(-1, 3))]
    if uvs and len(uvs) == len(triangles):
        lists.append(("texcoord", "f4", np.array(uvs)))
    table = np.zeros(
        len(triangles),
        dtype=[field for name, kind, values in lists for field in ((f"{name} n", "u1"), (name, header.order + kind, (values.shape[1],)))],
    )
    for name, _, values in lists:
        table[f"{name} n"], table[name] = values.shape[1], values
    return _written(header, data[vertices[0] : vertices[1]], [(name, {"i4": "int", "f4": "float"}[kind]) for name, kind, _ in lists], table)


def _face_row(data: bytes, at: int, face: _Element) -> tuple[list[int], list[float], int]:
    """Corners and texture coordinates of the face whose row starts at a byte, and where the next one starts."""
    corners: list[int] = []
    uv: list[float] = []
    for prop in face.properties:
        count = 1
        if prop.count is not None:
            count, at = _number(data, at, prop.count), at + prop.count.itemsize
        stop = at + count * prop.dtype.itemsize
        if prop.count is not None and stop <= len(data):
            values = np.frombuffer(data, dtype=prop.dtype, count=count, offset=at).tolist()
            if prop.name == "texcoord":
                uv = values
            elif prop.name in _CORNERS or not corners:
                corners = [int(value) for value in values]
        at = stop
    return corners, uv, at


def _written(header: PlyHeader, vertices: bytes, lists: list[tuple[str, str]], faces: np.ndarray) -> bytes:
    """A PLY file of a vertex table and even faces."""
    vertex = next(element for element in header.elements if element.name == "vertex")
    names = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
    lines = ["ply", f"format binary_{'big' if header.order == '>' else 'little'}_endian 1.0"]
    lines += [f"comment TextureFile {header.texture}"] if header.texture else []
    lines += [f"element vertex {vertex.rows}", *(f"property {names[prop.dtype.str[1:]]} {prop.name}" for prop in vertex.properties)]
    lines += [f"element face {len(faces)}", *(f"property list uchar {kind} {name}" for name, kind in lists), "end_header\n"]
    return "\n".join(lines).encode("latin-1") + vertices + faces.tobytes()
