"""PLY in every form that its format allows; damaged ones are called damaged."""

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from torchtrack.errors import LimitError, ModelError, TorchtrackWarning
from torchtrack.object_model import ObjectModel

BOX = trimesh.creation.box((0.1, 0.1, 0.1))
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
CORNERS = [(x, y, z) for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)]
QUADS = [tuple(reversed(quad)) for quad in QUADS]
MIXED = [QUADS[0][:3], (QUADS[0][0], *QUADS[0][2:]), *QUADS[1:]]


def ply(faces: list[tuple[int, ...]], kind: str = "binary_little_endian", extra: bool = False, names: tuple[str, str] = ("float", "int")) -> bytes:
    """A PLY file of a box, with extra values in its rows if asked for."""
    header = f"ply\nformat {kind} 1.0\ncomment made here\nobj_info no element\nelement vertex 8\n"
    header += "".join(f"property {names[0]} {axis}\n" for axis in "xyz") + ("property uchar grade\n" if extra else "")
    header += f"element face {len(faces)}\n" + ("property short flag\n" if extra else "")
    header += f"property list uchar {names[1]} vertex_indices\n" + ("property list uchar float more\n" if extra else "") + "end_header\n"
    if kind == "ascii":
        rows = [[*corner, *([7] if extra else [])] for corner in CORNERS]
        rows += [[*([3] if extra else []), len(face), *face, *([1, 0.5] if extra else [])] for face in faces]
        return (header + "\n".join(" ".join(map(str, row)) for row in rows) + "\n").encode()
    order = "<" if "little" in kind else ">"
    float_code, int_code = {"float": "f", "float32": "f", "double": "d"}[names[0]], {"int": "i", "uint32": "I", "ushort": "H"}[names[1]]
    body = b"".join(struct.pack(f"{order}3{float_code}", *corner) + (b"\7" if extra else b"") for corner in CORNERS)
    for face in faces:
        body += struct.pack(f"{order}h", 3) if extra else b""
        body += struct.pack(f"{order}B{len(face)}{int_code}", len(face), *face) + (struct.pack(f"{order}Bf", 1, 0.5) if extra else b"")
    return header.encode() + body


def read(folder: Path, data: bytes) -> ObjectModel:
    (folder / "box.ply").write_bytes(data)
    return ObjectModel.from_file(folder / "box.ply")


@pytest.mark.parametrize("faces", [QUADS, MIXED], ids=["quads", "mixed"])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("extra", [False, True], ids=["bare", "extra"])
def test_forms_that_the_format_allows(tmp_path: Path, faces: list, kind: str, extra: bool):
    model = read(tmp_path, ply(faces, kind, extra))
    assert len(model.edge_points) == 12
    assert len(model.triangles) == 12
    assert model.diameter_m == pytest.approx(0.1 * 3**0.5, rel=1e-5)


@pytest.mark.parametrize("names", [("double", "int"), ("float32", "uint32"), ("float", "ushort")])
def test_types(tmp_path: Path, names: tuple[str, str]):
    assert len(read(tmp_path, ply(MIXED, names=names)).edge_points) == 12


def test_polygons_with_texture_coordinates(tmp_path: Path):
    """A card of a triangle and a quadrangle, printed half dark, half bright."""
    pattern = np.full((64, 64), 230, np.uint8)
    pattern[:, :32] = 20
    Image.fromarray(pattern).save(tmp_path / "my card.png")
    corners = [(0, 0), (0.1, 0), (0.1, 0.1), (0, 0.1), (0.05, 0.1)]
    header = "ply\nformat binary_little_endian 1.0\ncomment TextureFile my card.png\nelement vertex 5\n" + "".join(
        f"property float {a}\n" for a in "xyz"
    )
    header += "element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
    body = b"".join(struct.pack("<3f", *corner, 0) for corner in corners)
    for face in ((0, 1, 2, 4), (0, 4, 3)):
        body += struct.pack(f"<B{len(face)}i", len(face), *face)
        body += struct.pack(f"<B{2 * len(face)}f", 2 * len(face), *(10 * value for i in face for value in corners[i]))
    model = read(tmp_path, header.encode() + body)
    assert len(model.triangles) == 3
    assert len(model.texture_points) > 20
    assert (model.texture_points[:, 0] - 0.05).abs().max() < 1e-4


@pytest.mark.parametrize("depth", ["grey 16 bit", "palette", "cmyk", "grey and alpha", "rgba"])
def test_pixel_types(tmp_path: Path, depth: str):
    """A print that is read whatever its pixels are."""
    pattern = np.full((64, 64), 200, np.uint8)
    pattern[:, :32] = 60
    images = {
        "grey 16 bit": Image.fromarray(pattern.astype(np.uint16) * 257), "palette": Image.fromarray(pattern).convert("P"),
        "cmyk": Image.fromarray(pattern).convert("RGB").convert("CMYK"), "grey and alpha": Image.fromarray(pattern).convert("LA"),
        "rgba": Image.fromarray(pattern).convert("RGBA"),
    }  # fmt: skip
    images[depth].save(tmp_path / ("card.tif" if depth == "cmyk" else "card.png"))
    model = read(tmp_path, textured("card.tif" if depth == "cmyk" else "card.png"))
    assert len(model.texture_points) > 20
    assert (model.texture_points[:, 0] - 0.05).abs().max() < 1e-4


def textured(image: str) -> bytes:
    text = f"ply\nformat ascii 1.0\ncomment TextureFile {image}\nelement vertex 4\n" + "".join(
        f"property float {a}\n" for a in ("x", "y", "z", "s", "t")
    )
    return (
        text
        + "element face 2\nproperty list uchar int vertex_indices\nend_header\n0 0 0 0 0\n.1 0 0 1 0\n.1 .1 0 1 1\n0 .1 0 0 1\n3 0 1 2\n3 0 2 3\n"
    ).encode()


def test_images_that_cannot_be_used(tmp_path: Path, capfd: pytest.CaptureFixture):
    Image.fromarray(np.linspace(0, 9, 4096, dtype=np.float32).reshape(64, 64)).save(tmp_path / "hdr.tif")
    with pytest.warns(TorchtrackWarning, match=r"'hdr\.tif': its pixels are floats"):
        read(tmp_path, textured("hdr.tif"))
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.warns(TorchtrackWarning, match=r"'bad\.png': it is damaged"):
        read(tmp_path, textured("bad.png"))
    assert "Traceback" not in capfd.readouterr().err


def test_texture_without_coordinates(tmp_path: Path):
    Image.new("RGB", (8, 8)).save(tmp_path / "card.png")
    with pytest.warns(TorchtrackWarning, match=r"'card\.png': its faces have no texture coordinates"):
        read(tmp_path, ply(QUADS).replace(b"comment made here", b"comment TextureFile card.png"))


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("faces", [QUADS, MIXED], ids=["quads", "mixed"])
def test_file_that_is_cut_short(tmp_path: Path, kind: str, faces: list):
    data = ply(faces, kind)
    for size in (2, 30, len(data) // 2, len(data) - 12):
        with pytest.raises(ModelError, match=r"box\.ply' as a PLY mesh: .*(cut short|no header|do not fit).* export it again"):
            read(tmp_path, data[:size])


@pytest.mark.parametrize("corner", [8, -1, 2**31 - 1, 10_000_000])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_indices_out_of_range(tmp_path: Path, corner: int, kind: str):
    with pytest.raises(ModelError, match=r"face 5 of '.*box\.ply' names the vertices .*and there are 8"):
        read(tmp_path, ply([*[quad[:3] for quad in QUADS[:5]], (0, 1, corner)], kind))


@pytest.mark.parametrize(
    ("old", "new", "error", "message"),
    [
        (b"element face 6", b"element face 10000000", LimitError, r"10,000,000 faces.*limits\.faces"),
        (b"element face 6", b"element face 1000000", ModelError, "declares .*1000000 of 'face'.*cut short"),
        (b"element face 6", b"element face -6", ModelError, "header is wrong"),
        (b"element face 6", b"element face six", ModelError, "header is wrong"),
        (b"property float x\n", b"property flout x\n", ModelError, "header is wrong"),
        (b"element vertex 8\n", b"", ModelError, "header is wrong"),
        (b"binary_little_endian", b"binary_middle_endian", ModelError, "its format is 'binary_middle_endian'"),
        (b"element face", b"element tristrips", ModelError, "triangle strips"),
        (b"element face", b"element nothing 3\nelement face", ModelError, "do not fit its header"),
        (b"property float y", b"property float x", ModelError, "do not fit its header"),
    ],
)
def test_damaged_headers(tmp_path: Path, old: bytes, new: bytes, error: type[Exception], message: str):
    with pytest.raises(error, match=message):
        read(tmp_path, ply(QUADS).replace(old, new))


def test_list_that_is_longer_than_the_file(tmp_path: Path):
    data = ply([quad[:3] for quad in QUADS]).replace(b"list uchar int", b"list int int")
    with pytest.raises(ModelError, match="cut short|a number of corners is wrong"):
        read(tmp_path, data)


def test_text_list_that_is_longer_than_its_line(tmp_path: Path):
    with pytest.raises(ModelError, match="face 2 says that it has '10000000' corners, and 4 numbers follow"):
        read(tmp_path, ply(QUADS, "ascii").replace(b"\n4 %d %d" % QUADS[2][:2], b"\n10000000 %d %d" % QUADS[2][:2]))
