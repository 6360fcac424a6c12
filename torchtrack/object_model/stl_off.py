"""STL and OFF: files whose counts do not fit what they hold are called damaged, with where."""

from pathlib import Path

from trimesh.util import comment_strip

from torchtrack.core.limits import check_limit
from torchtrack.errors import ModelError
from torchtrack.object_model.notices import tell
from torchtrack.object_model.side_files import MeshText, SideFiles

_STL_HEADER, _STL_TRIANGLE = 84, 50


def read_stl(path: Path) -> MeshText:
    """An STL file, text or binary, as trimesh reads it.

    Raises:
        ModelError: if it is damaged.
        LimitError: if it has more faces than the limit.
    """
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    exact = len(data) >= _STL_HEADER and len(data) == _STL_HEADER + _STL_TRIANGLE * count
    if not exact and data.lstrip()[:5].lower() == b"solid" and b"facet" in data.lower():
        _check_text(path, data)
        return MeshText(data, "stl", SideFiles(path))
    if len(data) < _STL_HEADER:
        raise _damaged(path, "STL", f"it has {len(data)} bytes, and not even a header of {_STL_HEADER}")
    stop = _STL_HEADER + _STL_TRIANGLE * count
    if stop > len(data):
        there = (len(data) - _STL_HEADER) // _STL_TRIANGLE
        raise _damaged(path, "STL", f"its header declares {count} triangles, and {there} follow it: it was cut short, or is no STL file")
    check_limit("faces", count, path)
    if count == 0 and len(data) > _STL_HEADER:
        raise _damaged(path, "STL", f"its header declares no triangles, and {len(data) - _STL_HEADER} bytes follow it")
    if stop < len(data):
        tell(f"'{path}' has {len(data) - stop} bytes after the {count} triangles that its header declares; they are not read.")
    return MeshText(data[:stop], "stl", SideFiles(path))


def _check_text(path: Path, data: bytes) -> None:
    text = data.lower()
    facets, vertices = text.count(b"facet normal"), text.count(b"vertex ") + text.count(b"vertex\t")
    check_limit("faces", facets, path)
    if text.count(b"endsolid") == 0 or vertices < 3 * facets:
        raise _damaged(
            path,
            "STL",
            f"it begins {facets} facets and has {vertices} vertices, and {'an' if b'endsolid' in text else 'no'} 'endsolid': it was cut short",
        )


def read_off(path: Path) -> MeshText:
    """An OFF file as trimesh reads it.

    Raises:
        ModelError: if it is damaged.
        LimitError: if it has more faces or vertices than the limits.
    """
    data = path.read_bytes()
    text = comment_strip(data.decode("latin-1")).strip()
    first, _, rest = text.partition("\n")
    if "OFF" not in first:
        raise _damaged(path, "OFF", f"it does not begin with OFF, but with {first[:20]!r}")
    if "BINARY" in first:
        raise ModelError(f"'{path}' is a binary OFF file, which is not read. Export it as text, or as PLY.")
    lines = [line for line in [first.split("OFF", 1)[1], *rest.splitlines()] if line.strip()]
    try:
        vertices, faces = (int(word) for word in lines[0].split()[:2])
    except (ValueError, IndexError) as error:
        raise _damaged(path, "OFF", "the numbers of vertices and faces after OFF are missing or wrong") from error
    check_limit("vertices", vertices, path)
    check_limit("faces", faces, path)
    if min(vertices, faces) < 0 or len(lines) < 1 + vertices + faces:
        raise _damaged(path, "OFF", f"it declares {vertices} vertices and {faces} faces, and {len(lines) - 1} lines follow: it was cut short")
    _check_faces(path, lines[1 + vertices : 1 + vertices + faces])
    return MeshText("\n".join(["OFF", *lines]).encode(), "off", SideFiles(path))


def _check_faces(path: Path, lines: list[str]) -> None:
    for number, line in enumerate(lines):
        count, *corners = line.split()
        if not count.isdecimal() or len(corners) < int(count):
            raise _damaged(path, "OFF", f"face {number} says that it has '{count}' corners, and {len(corners)} numbers follow")


def _damaged(path: Path, kind: str, why: str) -> ModelError:
    return ModelError(f"cannot read '{path}' as an {kind} mesh: {why}. Copy it again, or export it again.")
