"""STL and OFF: what the formats allow is read, what is damaged is called damaged."""

from pathlib import Path

import pytest
import trimesh

from torchtrack.errors import LimitError, ModelError, TorchtrackWarning
from torchtrack.object_model import ObjectModel

BOX = trimesh.creation.box((0.1, 0.1, 0.1))
STL = BOX.export(file_type="stl")
TEXT = BOX.export(file_type="stl_ascii")
OFF = BOX.export(file_type="off")


def read(folder: Path, name: str, data: bytes | str) -> ObjectModel:
    (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    return ObjectModel.from_file(folder / name)


@pytest.mark.parametrize("data", [STL, b"solid box".ljust(80) + STL[80:], TEXT, TEXT.upper(), TEXT.replace("\n", "\r\n"), "\n" + TEXT])
def test_stl(tmp_path: Path, data: bytes | str):
    assert len(read(tmp_path, "box.stl", data).edge_points) == 12


def test_stl_with_bytes_at_its_end(tmp_path: Path):
    with pytest.warns(TorchtrackWarning, match="7 bytes after the 12 triangles"):
        assert len(read(tmp_path, "box.stl", STL + b"\0" * 7).edge_points) == 12


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (STL[:-1], "declares 12 triangles, and 11 follow it: it was cut short"),
        (STL[:80] + b"\xff\xff\xff\xff" + STL[84:], "declares 4294967295 triangles, and 12 follow"),
        (STL[:80] + b"\0\0\0\0" + STL[84:], "declares no triangles, and 600 bytes follow"),
        (STL[:50], "has 50 bytes"),
        (TEXT[: len(TEXT) // 2], "no 'endsolid': it was cut short"),
        (TEXT.replace("vertex", "vortex", 1), "36 vertices|35 vertices"),
        (TEXT.replace("vertex ", "vertex x", 1), "could not be read to its end"),
        (STL[:84], "has no triangles|declares 12 triangles, and 0 follow"),
    ],
)
def test_damaged_stl(tmp_path: Path, data: bytes | str, message: str):
    with pytest.raises(ModelError, match=rf"box\.stl'.*({message})"):
        read(tmp_path, "box.stl", data)


@pytest.mark.parametrize("start", ["OFF\n", "OFF\n# a comment\n\n", "OFF ", "  OFF\r\n", "COFF\n"])
def test_off(tmp_path: Path, start: str):
    rest = OFF.split("\n", 1)[1]
    if start == "COFF\n":
        lines = rest.splitlines()
        rest = "\n".join([lines[0], *(line + " 0.5 0.5 0.5 1" for line in lines[1:9]), *lines[9:]])
    assert len(read(tmp_path, "box.off", start + rest).edge_points) == 12


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (OFF[: len(OFF) // 2], "declares 8 vertices and 12 faces, and .* lines follow: it was cut short"),
        (OFF.replace("8 12", "8 13"), "8 vertices and 13 faces"),
        (OFF.replace("8 12", "eight 12"), "numbers of vertices and faces after OFF are missing"),
        (OFF.replace("8 12", "-8 12"), "it was cut short"),
        ("OFF", "numbers of vertices and faces"),
        ("OFF BINARY\n", "is a binary OFF file"),
        ("nothing", "does not begin with OFF"),
        (OFF.rstrip() + "x", "cannot read"),
        (OFF.rstrip().rsplit(" ", 1)[0], "face 11 says that it has '3' corners, and 2 numbers follow"),
        (OFF.rstrip()[:-1] + "9", "outside the range"),
    ],
)
def test_damaged_off(tmp_path: Path, data: str, message: str):
    with pytest.raises(ModelError, match=message):
        read(tmp_path, "box.off", data)


def test_sizes_are_limited(tmp_path: Path):
    with pytest.raises(LimitError, match=r"limits\.faces"):
        read(tmp_path, "box.off", OFF.replace("8 12", "8 90000000"))
