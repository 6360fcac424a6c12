"""Models of too many parts, faces and pixels, and of indices that lead nowhere."""

import json
import os
import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from PIL import Image

Make = Callable[[Path], None]
_CORNERS = "v 0 0 0\nv 0.1 0 0\nv 0.1 0.1 0\nv 0 0 0.1\n"
_FACES = "f 1 2 3\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
_PLY = "ply\nformat ascii 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\nelement face {faces}\n"
_PLY += "property list uchar int vertex_indices\nend_header\n0 0 0\n0.1 0 0\n0 0.1 0\n0 0 0.1\n{rows}"


def model_inputs() -> Iterator[tuple[str, str, str, Make]]:
    """Name, kind, file, and what makes it."""
    text = {
        "obj_out_of_range.obj": _CORNERS + "f 1 2 99\nf 1 2 3\n",
        "obj_negative.obj": _CORNERS + "f -1 -2 -99\nf -1 -2 -3\n",
        "obj_zero.obj": _CORNERS + "f 0 1 2\n",
        "obj_long_index.obj": _CORNERS + "f 1 2 " + "9" * 400 + "\n",
        "obj_uv_out_of_range.obj": _CORNERS + "vt 0 0\nf 1/9 2/9 3/9\n" + _FACES,
        "obj_nan.obj": _CORNERS.replace("0.1", "nan") + _FACES,
        "obj_huge.obj": _CORNERS.replace("0.1", "1e308") + _FACES,
        "obj_polygon.obj": _CORNERS + "f " + "1 2 3 " * 100_000 + "\n",
        "obj_blanks.obj": "mtllib a" + " " * 200_000 + "b\n" + "mtllib " + " \t" * 100_000 + "\n" + _CORNERS + _FACES,
        "obj_mtllibs.obj": "mtllib a.mtl\n" * 20_000 + _CORNERS + _FACES,
        "obj_mtl_folder.obj": "mtllib .\nmtllib /dev/zero\n" + _CORNERS + _FACES,
        "obj_long_name.obj": "mtllib " + "a" * 5000 + "\n" + _CORNERS + _FACES,
        "ply_indices.ply": _PLY.format(vertices=4, faces=4, rows="3 0 1 2\n3 0 1 3\n3 0 2 9999999\n3 1 2 -3\n"),
        "ply_many_faces.ply": _PLY.format(vertices=4, faces=4_000_000_000, rows="3 0 1 2\n"),
        "ply_many_vertices.ply": _PLY.format(vertices=10**12, faces=4, rows="3 0 1 2\n"),
        "ply_long_list.ply": _PLY.format(vertices=4, faces=1, rows="255 " + "0 1 2 " * 85 + "\n"),
        "ply_texture_blanks.ply": _PLY.format(vertices=4, faces=1, rows="3 0 1 2\n").replace("element v", "comment TextureFile " + " " * 9000 + "x\nelement v", 1),
        "off_many.off": "OFF\n4000000000 4000000000 0\n0 0 0\n",
        "stl_text.stl": "solid a\n" + "facet normal 0 0 0\nouter loop\n" * 50_000,
    }  # fmt: skip
    for file, content in text.items():
        yield Path(file).stem, "mesh", file, partial(Path.write_text, data=content)
    yield "ply_10_million_indices", "mesh", "x.ply", _many_indices
    yield "stl_count", "mesh", "x.stl", lambda path: path.write_bytes(bytes(80) + struct.pack("<I", 0xFFFFFFFF) + bytes(500))
    yield "glb_nodes", "mesh", "x.glb", partial(_glb, content={"nodes": [{"mesh": 0}] * 200_000, "scenes": [{"nodes": list(range(200_000))}]})
    chain = [{"children": [n + 1]} for n in range(5000)] + [{"mesh": 0}]
    yield "glb_chain", "mesh", "x.glb", partial(_glb, content={"nodes": chain, "scenes": [{"nodes": [0]}]})
    yield (
        "glb_cycle",
        "mesh",
        "x.glb",
        partial(_glb, content={"nodes": [{"children": [1], "mesh": 0}, {"children": [0]}], "scenes": [{"nodes": [0]}]}),
    )
    doubling = [{"children": [n + 1] * 4} for n in range(14)] + [{"mesh": 0}]
    yield "glb_doubling", "mesh", "x.glb", partial(_glb, content={"nodes": doubling, "scenes": [{"nodes": [0]}]})
    yield "glb_length", "mesh", "x.glb", lambda path: path.write_bytes(b"glTF" + struct.pack("<IIII", 2, 100, 0xFFFFFFF0, 0x4E4F534A) + bytes(80))
    yield "glb_accessor", "mesh", "x.glb", partial(_glb, content={"nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}]}, count=2_000_000_000)
    yield "glb_nested", "mesh", "x.glb", lambda path: path.write_bytes(_glb_bytes(b'{"asset":' + b"[" * 100_000, b""))
    yield "glb_matrix", "mesh", "x.glb", partial(_glb, content={"nodes": [{"mesh": 0, "matrix": [1e308] * 16}], "scenes": [{"nodes": [0]}]})
    yield "texture_13000", "mesh", "x.obj", _large_texture
    yield "texture_fifo", "mesh", "x.obj", _texture_fifo
    yield "lines_many", "lines", "x.obj", lambda path: path.write_text("v 0 0 0\nv 1 0 0\n" + "l " + "1 2 " * 3_000_000 + "\n")
    yield "lines_out_of_range", "lines", "x.obj", lambda path: path.write_text("v 0 0 0\nv 0.1 0 0\nl 1 2 9\nl 0 1\nl -9 1\n")
    yield "lines_ragged", "lines", "x.json", lambda path: path.write_text('{"polylines": [[[0, 0], [1, 2, 3]], [], [[]], 5, null, "a"]}')
    yield "lines_deep", "lines", "x.json", lambda path: path.write_text('{"polylines": [[[[0, 0, 0]], [[1, 2, 3]]]], "unit": []}')


def _many_indices(path: Path) -> None:
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 3400000\nproperty list uchar int vertex_indices\nend_header\n"
    corners = struct.pack("<12f", 0, 0, 0, 0.1, 0, 0, 0, 0.1, 0, 0, 0, 0.1)
    path.write_bytes(head.encode() + corners + struct.pack("<Biii", 3, 0, 1, 2) * 3_400_000)


def _glb(path: Path, content: dict[str, object], count: int = 4) -> None:
    buffer = struct.pack("<12f", 0, 0, 0, 0.1, 0, 0, 0, 0.1, 0, 0, 0, 0.1) + struct.pack("<12H", 0, 1, 2, 0, 1, 3, 0, 2, 3, 1, 2, 3)
    whole = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3", "min": [0, 0, 0], "max": [0.1, 0.1, 0.1]},
            {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 24}],
        "buffers": [{"byteLength": len(buffer)}],
        **content,
    }
    path.write_bytes(_glb_bytes(json.dumps(whole).encode(), buffer))


def _glb_bytes(text: bytes, buffer: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(buffer), 0x004E4942) + buffer
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


def _textured(path: Path) -> None:
    path.write_text(
        "mtllib x.mtl\n" + _CORNERS + "vt 0 0\nvt 1 0\nvt 0 1\nusemtl a\n" + "f 1/1 2/2 3/3\nf 1/1 2/2 4/3\nf 2/1 3/2 4/3\nf 3/1 1/2 4/3\n"
    )
    path.with_name("x.mtl").write_text("newmtl a\nmap_Kd x.png\n")


def _large_texture(path: Path) -> None:
    _textured(path)
    Image.new("1", (13_000, 13_000)).save(path.with_name("x.png"))


def _texture_fifo(path: Path) -> None:

    _textured(path)
    os.mkfifo(path.with_name("x.png"))
