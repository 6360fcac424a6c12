"""OBJ as people's tools write it: indices, lines, names, options of textures."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from torchtrack.core.limits import Limits, limits
from torchtrack.errors import LimitError, ModelError, TorchtrackWarning
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.obj import image_name

BOX = trimesh.creation.box((0.1, 0.1, 0.1))


def box_lines(separator: str = " ") -> list[str]:
    return [separator.join(["v", *(f"{x:g}" for x in vertex)]) for vertex in BOX.vertices] + [
        separator.join(["f", *(str(i + 1) for i in face)]) for face in BOX.faces
    ]


def write(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def card(folder: Path, use: str = "usemtl ink", library: str = "mtllib card.mtl", mtl: str = "newmtl ink\nKd 1 1 1\nmap_Kd card.png\n") -> Path:
    """A card printed half dark, half bright."""
    pattern = np.full((64, 64, 3), 230, np.uint8)
    pattern[:, :32] = 20
    Image.fromarray(pattern).save(folder / "card.png")
    (folder / "card.mtl").write_text(mtl)
    corners = "v 0 0 0\nv 0.1 0 0\nv 0.1 0.1 0\nv 0 0.1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    return write(folder / "card.obj", f"{library}\n{corners}{use}\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")


def printed(model: ObjectModel) -> bool:
    return len(model.texture_points) > 20 and bool((model.texture_points[:, 0] - 0.05).abs().max() < 1e-4)


@pytest.mark.parametrize("value", ["-s 1 1 1 card.png", "-bm 0.5 -clamp on card.png", "-o 0.5 0 -mm 0 1 card.png", "-imfchan l -blendu off card.png"])
@pytest.mark.parametrize("key", ["map_Kd ", "map_kd\t", "\tmap_Kd "])
def test_options_of_a_texture(tmp_path: Path, value: str, key: str):
    assert printed(ObjectModel.from_file(card(tmp_path, mtl=f"newmtl ink\nKd 1 1 1\n{key}{value}\n")))


@pytest.mark.parametrize(
    ("value", "name"),
    [
        ("a b.png", "a b.png"), ("-s 1 1 1 my file-1.png", "my file-1.png"), ("-S 2 card.png", "card.png"), ("-mm 0 1 -o 1 2 3 1.png", "1.png"),
        ("-t 1 2.png", "2.png"), ("-weird.png", "-weird.png"),
    ],
)  # fmt: skip
def test_name_after_options(value: str, name: str):
    assert image_name(value) == name


@pytest.mark.parametrize("name", ["tex\\card 1.png", "C:\\Users\\me\\Card 1.PNG", '"card 1.png"', "./tex/card%201.png", "/home/me/card 1.png"])
def test_names_as_other_computers_write_them(tmp_path: Path, name: str):
    path = card(tmp_path, mtl=f"newmtl ink\nKd 1 1 1\nmap_Kd {name}\n")
    (tmp_path / "tex").mkdir()
    (tmp_path / "tex" / "card 1.png").write_bytes((tmp_path / "card.png").read_bytes())
    (tmp_path / "card.png").rename(tmp_path / "card 1.png")
    assert printed(ObjectModel.from_file(path))


def test_library_with_blanks_among_several_and_images_beside_it(tmp_path: Path):
    path = card(tmp_path, library="mtllib other.mtl\nmtllib sub\\my ink.mtl")
    (tmp_path / "other.mtl").write_text("newmtl other\nKd 1 0 0\n")
    (tmp_path / "sub").mkdir()
    (tmp_path / "card.mtl").rename(tmp_path / "sub" / "my ink.mtl")
    (tmp_path / "card.png").rename(tmp_path / "sub" / "card.png")
    assert printed(ObjectModel.from_file(path))


@pytest.mark.parametrize(
    ("use", "message"),
    [
        ("", r"names the textures 'card\.png' \('ink'\), and no face uses them.*usemtl"),
        ("usemtl ink.001", r"uses the material 'ink\.001', which 'card\.mtl' does not define"),
    ],
)
def test_texture_that_no_face_uses(tmp_path: Path, use: str, message: str):
    with pytest.warns(TorchtrackWarning, match=message):
        model = ObjectModel.from_file(card(tmp_path, use=use))
    assert len(model.texture_points) == 0


@pytest.mark.parametrize(("content", "why"), [(b"no image", "damaged, or no image"), (b"", "damaged, or no image"), (None, "data are damaged")])
def test_image_that_is_damaged(tmp_path: Path, content: bytes | None, why: str):
    path = card(tmp_path)
    image = tmp_path / "card.png"
    image.write_bytes(image.read_bytes()[:90] if content is None else content)
    with pytest.warns(
        TorchtrackWarning, match=rf"the texture of '.*card\.obj' cannot be read: only the geometry is used\. It is 'card\.png': .*{why}"
    ):
        assert len(ObjectModel.from_file(path).texture_points) == 0


def test_image_that_is_a_folder(tmp_path: Path):
    path = card(tmp_path)
    (tmp_path / "card.png").unlink()
    (tmp_path / "card.png").mkdir()
    with pytest.warns(TorchtrackWarning, match=r"names 'card\.png', which cannot be found"):
        ObjectModel.from_file(path)


def test_texture_without_coordinates(tmp_path: Path):
    path = card(tmp_path)
    write(path, path.read_text().replace("1/1 2/2 3/3", "1 2 3").replace("1/1 3/3 4/4", "1 3 4"))
    with pytest.warns(TorchtrackWarning, match="its faces have no texture coordinates"):
        ObjectModel.from_file(path)


FORMS = {
    "tabs": "\n".join(box_lines("\t")),
    "indented": "\n".join("  " + line for line in box_lines()),
    "old Mac": "\r".join(box_lines()),
    "Windows": "\r\n".join(box_lines()) + "\r\n",
    "comments": "\n".join(line + " # usemtl x" for line in box_lines()),
    "continued": "\n".join(line.replace(" ", " \\\n ", 1) for line in box_lines()),
    "byte order mark": "\ufeff" + "\n".join(box_lines()),
    "weights": "\n".join(line + (" 1.0" if line[0] == "v" else "") for line in box_lines()),
    "colours": "\n".join(line + (" 0.5 0.5 0.5" if line[0] == "v" else "") for line in box_lines()),
    "names": "o Gehäuse\ng a b\ns off\n" + "\n".join(box_lines()),
    "negative": "\n".join(box_lines()[:8] + ["f " + " ".join(str(i - 8) for i in face) for face in BOX.faces]),
}


@pytest.mark.parametrize("form", FORMS)
def test_forms_that_the_format_allows(tmp_path: Path, form: str):
    model = ObjectModel.from_file(write(tmp_path / "box.obj", FORMS[form]))
    assert len(model.edge_points) == 12
    assert model.diameter_m == pytest.approx(0.1 * 3**0.5, rel=1e-5)


def test_latin_1_names(tmp_path: Path):
    assert len(ObjectModel.from_file(write(tmp_path / "box.obj", b"o Geh\xe4use\n" + "\n".join(box_lines()).encode())).edge_points) == 12


def test_negative_indices_count_from_the_newest_vertex(tmp_path: Path):
    """Two boxes, each with its faces after its own vertices."""
    faces = ["f " + " ".join(str(i - 8) for i in face) for face in BOX.faces]
    other = [f"v {x + 0.3:g} {y:g} {z:g}" for x, y, z in BOX.vertices]
    model = ObjectModel.from_file(write(tmp_path / "two.obj", "\n".join([*box_lines()[:8], *faces, *other, *faces])))
    assert len(model.edge_points) == 24
    torch.testing.assert_close(model.centre, torch.tensor([0.15, 0, 0]))


def test_polygons(tmp_path: Path):
    ring = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    text = "\n".join(f"v {0.05 * np.cos(a):g} {0.05 * np.sin(a):g} 0" for a in ring) + "\nf 1 2 3 4 5 6\n"
    assert len(ObjectModel.from_file(write(tmp_path / "six.obj", text)).triangles) == 4


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("f 1 2 9", r'line 21 of .*\("f 1 2 9"\) names vertex 9, and the file has 8'),
        ("f 1 2 0", r"line 21 of .* names v 0, which is not there"),
        ("f 1 2 -9", r"line 21 of .* names v -9, which is not there: 8 come before it"),
        ("f 1 2 x", r"line 21 of .* is damaged: 'x' is no corner of a face"),
        ("f 1 2 3.5", "is no corner of a face"),
        ("v 0 0", "cannot read|are not finite|damaged"),
        ("v 0 0 zero", "cannot read .*box.obj"),
        ("v 0 0 nan\nf 1 2 9", "not finite"),
    ],
)
def test_damaged_lines(tmp_path: Path, line: str, message: str):
    with pytest.raises(ModelError, match=message):
        ObjectModel.from_file(write(tmp_path / "box.obj", "\n".join([*box_lines(), line]) + "\n"))


def test_lines_beside_faces_are_told(tmp_path: Path):
    with pytest.warns(TorchtrackWarning, match="1 lines, curves or free-form surfaces of .* are not used"):
        ObjectModel.from_file(write(tmp_path / "box.obj", "\n".join([*box_lines(), "l 1 2"])))


def test_sizes_are_limited(tmp_path: Path):
    path = write(tmp_path / "box.obj", "\n".join(box_lines()))
    for chosen in (Limits(faces=11), Limits(vertices=7), Limits(mesh_bytes=50)):
        with limits(chosen), pytest.raises(LimitError, match="raise the setting limits"):
            ObjectModel.from_file(path)
    path = card(tmp_path)
    with limits(Limits(texture_pixels=64 * 64 - 1)), pytest.raises(LimitError, match=r"card\.obj' asks for 4,096 texture pixels"):
        ObjectModel.from_file(path)


def test_very_many_libraries(tmp_path: Path):
    with pytest.raises(ModelError, match="names 500 material libraries, expected at most 100"):
        ObjectModel.from_file(write(tmp_path / "box.obj", "mtllib " + " ".join(f"{i}.mtl" for i in range(500)) + "\n" + "\n".join(box_lines())))


def test_points_of_two_coordinates(tmp_path: Path):
    with pytest.raises(ModelError, match=r"flat\.obj"):
        ObjectModel.from_file(write(tmp_path / "flat.obj", "v 0 0\nv 1 0\nv 0 1\n"))


def test_textures_of_one_dimension_are_told(tmp_path: Path):
    path = card(tmp_path)
    write(path, "\n".join(line[:4] if line.startswith("vt") else line for line in path.read_text().splitlines()))
    with pytest.warns(TorchtrackWarning, match="its faces have no texture coordinates"):
        ObjectModel.from_file(path)


def test_errors_name_the_file(tmp_path: Path):
    with pytest.raises(ModelError, match=r"flat\.obj' cannot be used: all 1 faces of the mesh are degenerate"):
        ObjectModel.from_file(write(tmp_path / "flat.obj", "v 0 0 0\nv .1 0 0\nv .2 0 0\nf 1 2 3\n"), name="thing")
