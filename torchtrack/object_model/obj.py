"""OBJ: what its format allows and trimesh would misread is rewritten; materials are found by name, wherever their images lie.

trimesh reads an OBJ file as most tools write it. Indices that count from the newest vertex, tabs, indented lines, lines that
go on after a backslash, comments at the end of a line and indices of zero would be misread without a word: files with any of
these are read line by line here, checked, and written anew for trimesh.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from torchtrack.core.limits import check_limit
from torchtrack.errors import ModelError
from torchtrack.object_model.notices import tell
from torchtrack.object_model.side_files import MeshText, SideFiles, find_side_file

_PLAIN_END = re.compile(rb"\r(?!\n)")
_UNUSUAL = re.compile(
    rb"^[ \t]+\S|^\w+\t|^f[^\n]*[-\t\x0b]|^f[^\n]*\s0|\\[ \t]*\r?\n|^[vf][^\n]*#|^[^\n#]*#[^\n]*(?:usemtl|mtllib)|^f[^\n]*[^\d\s/-][^\n]*$",
    re.MULTILINE,
)
_MOST_LIBRARIES = 100
# Options of a texture map and how many values each takes, in the MTL format; -o, -s and -t take one to three.
_OPTION = re.compile(
    r"-(?:(?:blendu|blendv|cc|clamp|texres|imfchan|type|boost|bm)\s+\S+|mm\s+\S+\s+\S+|[ost](?:\s+[-+]?[\d.][\d.eE+-]*(?=\s)){1,3})\s+", re.IGNORECASE
)


@dataclass(frozen=True)
class ObjMaterials:
    """What the material libraries of an OBJ file say.

    Attributes:
        libraries: as its lines name them.
        materials: that they define.
        images: of those that have one.
        missing: libraries and images that are not there.
    """

    libraries: tuple[str, ...]
    materials: frozenset[str]
    images: dict[str, str]
    missing: tuple[str, ...]


def read_obj(path: Path) -> MeshText:
    """An OBJ file as trimesh reads it, with one material library whose images are plain names.

    Warns (:class:`TorchtrackWarning`) of lines and free-form surfaces beside faces, which are not used.

    Raises:
        ModelError: if a line makes no sense, or a face names a vertex that is not there.
        LimitError: if it has more vertices or faces than the limits.
    """
    data = path.read_bytes()
    if _PLAIN_END.search(data):
        data = _PLAIN_END.sub(b"\n", data)
    check_limit("vertices", len(re.findall(rb"^[ \t]*v[ \t]", data, re.MULTILINE)), path)
    check_limit("faces", len(re.findall(rb"^[ \t]*f[ \t]", data, re.MULTILINE)), path)
    text = _decoded(data)
    if _UNUSUAL.search(data):
        text = "\n".join(_plain_lines(text, path))
    others = re.findall(r"^[ \t]*(?:l|curv|curv2|surf)[ \t]", text, re.MULTILINE)
    if others:
        tell(
            f"{len(others)} lines, curves or free-form surfaces of '{path}' are not used: only its faces are. Convert them to faces, or delete them."
        )
    materials, library = _materials(path, text)
    _tell_unused(path, text, materials)
    files = SideFiles(path, dict.fromkeys(materials.libraries[:1], library.encode()))
    return MeshText(text.encode(), "obj", files, materials.missing, materials.images)


def _decoded(data: bytes) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def joined_lines(text: str) -> Iterator[tuple[int, str]]:
    """Number and text of each line, those that end in a backslash joined with the next, without comments."""
    begun, start = "", 0
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.split("#", 1)[0].rstrip()
        start = start or number
        if line.endswith("\\"):
            begun += line[:-1] + " "
            continue
        yield start, begun + line
        begun, start = "", 0
    if begun:
        yield start, begun


def _plain_lines(text: str, path: Path) -> Iterator[str]:
    """The lines with every index counted from the first vertex, and checked."""
    counts = {"v": 0, "vt": 0, "vn": 0}
    for number, line in joined_lines(text):
        kind, *values = line.split() or [""]
        if kind in counts:
            counts[kind] += 1
        if kind in ("f", "fo"):
            yield "f " + " ".join(_plain_corner(corner, counts, f"line {number} of '{path}' (\"{line[:80]}\")") for corner in values)
        elif kind in ("usemtl", "mtllib", "o", "g"):
            yield line.strip()
        else:
            yield " ".join([kind, *values])


def _plain_corner(corner: str, counts: dict[str, int], where: str) -> str:
    """A corner ``v/vt/vn`` of a face with its indices counted from one."""
    indices = []
    for text, kind in zip(corner.split("/"), ("v", "vt", "vn"), strict=False):
        if not text and kind != "v":
            indices.append("")
            continue
        try:
            index = int(text)
        except ValueError as error:
            raise ModelError(f"{where} is damaged: '{corner}' is no corner of a face. Export the model again.") from error
        index = index if index >= 0 else counts[kind] + index + 1
        if index < 1:
            raise ModelError(f"{where} names {kind} {text}, which is not there: {counts[kind]} come before it. Export the model again.")
        indices.append(str(index))
    return "/".join(indices)


def check_indices(path: Path) -> None:
    """Name the line of an OBJ file whose face names a vertex that is not there; nothing, if there is none.

    Raises:
        ModelError: with that line.
    """
    text = _decoded(path.read_bytes())
    count = len(re.findall(r"^[ \t]*v[ \t]", text, re.MULTILINE))
    for number, line in joined_lines(text):
        kind, *values = line.split() or [""]
        for corner in values if kind == "f" else []:
            index = corner.split("/")[0]
            if index.isdecimal() and int(index) > count:
                raise ModelError(
                    f"line {number} of '{path}' (\"{line[:80]}\") names vertex {index}, and the file has {count}: "
                    "it is damaged. Export the model again."
                )


def _materials(path: Path, text: str) -> tuple[ObjMaterials, str]:
    """The materials of an OBJ file, and one library of them all with the images' names alone."""
    lines: list[str] = []
    materials: list[str] = []
    images: dict[str, str] = {}
    missing: list[str] = []
    named = [name.strip() for name in re.findall(r"^[ \t]*mtllib[ \t]+(\S[^\n]*)$", text, re.MULTILINE)]
    # Several libraries may stand in one line; a name may hold blanks, too.
    names = dict.fromkeys(name for line in dict.fromkeys(named) for name in ([line] if find_side_file(path, line) else line.split()))
    if len(names) > _MOST_LIBRARIES:
        raise ModelError(f"'{path}' names {len(names)} material libraries, expected at most {_MOST_LIBRARIES}: it is damaged. Export it again.")
    for name in names:
        material_path = find_side_file(path, name)
        if material_path is None:
            missing.append(name)
            continue
        for line in _decoded(SideFiles(path).get(name)).splitlines():
            kind, rest = (*line.split(None, 1), "", "")[:2]
            rest = rest.strip()
            if kind == "newmtl":
                rest = " ".join(rest.split())
                materials.append(rest)
            elif kind.lower() == "map_kd" and materials:
                images[materials[-1]] = rest = image_name(rest)
                # An image's name is meant from the library's folder, and often written from the model's.
                image = find_side_file(material_path, rest) or find_side_file(path, rest)
                missing += [] if image else [rest]
                rest = str(image or rest)
            lines.append(f"{kind} {rest}")
    return ObjMaterials(tuple(named), frozenset(materials), images, tuple(missing)), "\n".join(lines)


def image_name(value: str) -> str:
    """The image of a texture map of an MTL file, without the options before it."""
    value = value.strip()
    start = 0
    while (option := _OPTION.match(value, start)) is not None:
        start = option.end()
    return value[start:]


def _tell_unused(path: Path, text: str, materials: ObjMaterials) -> None:
    """Warn of textures that the libraries of an OBJ file name and its faces do not use."""
    if not materials.images:
        return
    used = [name.strip() for name in re.findall(r"^usemtl[ \t]+(\S[^\n]*)$", text, re.MULTILINE)]
    unknown = [name for name in dict.fromkeys(used) if name not in materials.materials]
    listed = ", ".join(f"'{image}' ('{name}')" for name, image in list(materials.images.items())[:5])
    if unknown:
        tell(
            f"'{path}' uses the material '{unknown[0]}', which {', '.join(map(repr, materials.libraries))} does not define: of the faces "
            f"with it only the geometry is used. Textures are there for {listed}; make the names after usemtl and newmtl the same."
        )
    elif not any(name in materials.images for name in used):
        tell(
            f"'{path}' names the textures {listed}, and no face uses them: only the geometry is used. Add a line 'usemtl' with that material's name."
        )
