"""Object models from meshes: every format, every check, and the edges that can be a contour."""

import json
import os
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from torchtrack.errors import MissingFileError, ModelError, TorchtrackWarning, UnknownFormatError
from torchtrack.object_model import ModelSettings, ObjectModel
from torchtrack.object_model.placement import Placement

SIDE = 0.1


def cube(side: float = SIDE) -> trimesh.Trimesh:
    return trimesh.creation.box((side, side, side))


def wedge(angle_deg: float) -> trimesh.Trimesh:
    """Two squares that share the y axis and are bent by an angle, ridge up."""
    a = np.deg2rad(angle_deg / 2)
    x, z = 0.1 * np.cos(a), -0.1 * np.sin(a)
    vertices = [[-x, 0, z], [0, 0, 0], [x, 0, z], [-x, 0.1, z], [0, 0.1, 0], [x, 0.1, z]]
    return trimesh.Trimesh(vertices, [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]], process=False)


def lengths(model: ObjectModel) -> torch.Tensor:
    return (model.edge_points[:, 0] - model.edge_points[:, 1]).norm(dim=-1)


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "glb", "gltf", "off"])
@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("inch", 0.0254)])
def test_formats_and_units(tmp_path: Path, suffix: str, unit: str, metres: float):
    path = tmp_path / f"box.{suffix}"
    exported = cube(SIDE / metres).export(file_type=suffix)
    if isinstance(exported, dict):
        for name, content in exported.items():
            (tmp_path / name.replace("model.gltf", path.name)).write_bytes(content)
    else:
        path.write_bytes(exported.encode() if isinstance(exported, str) else exported)
    model = ObjectModel.from_file(path, unit=unit)
    assert model.name == "box"
    assert model.diameter_m == pytest.approx(SIDE * 3**0.5, rel=1e-5)
    torch.testing.assert_close(model.centre, torch.zeros(3), atol=1e-6, rtol=0)
    assert model.edge_is_crease.sum() == 12
    torch.testing.assert_close(lengths(model), torch.full((12,), SIDE))
    np.testing.assert_allclose(model.mesh.extents, SIDE, rtol=1e-5)


def test_cube_has_twelve_creases_and_no_diagonals():
    model = ObjectModel.from_mesh(cube(), name="box")
    assert model.edge_points.shape == (12, 2, 3)
    assert model.edge_is_crease.all()
    # Both normals of an edge point outwards, at right angles to it and to each other.
    along = model.edge_points[:, 1] - model.edge_points[:, 0]
    assert (model.edge_normals @ along[..., None]).abs().max() < 1e-6
    assert (model.edge_normals.prod(1).sum(-1)).abs().max() < 1e-6
    assert ((model.edge_normals * model.edge_points.mean(1, keepdim=True)).sum(-1) > 0).all()
    assert model.texture_points.shape == model.texture_tangents.shape == model.texture_normals.shape == (0, 3)
    assert model.segments.shape == (0, 2, 3)


@pytest.mark.parametrize(("angle", "creases"), [(20.0, 0), (30.0, 1)])
def test_crease_angle(angle: float, creases: int):
    model = ObjectModel.from_mesh(wedge(angle))
    ridge = model.edge_points[:, :, 0].abs().amax(1) < 1e-9
    assert ridge.sum() == 1
    assert model.edge_is_crease[ridge].sum() == creases
    # The border of an open sheet is drawn from either side.
    border = ~ridge
    assert border.sum() == 6
    assert model.edge_is_crease[border].all()
    torch.testing.assert_close(model.edge_normals[border, 0], -model.edge_normals[border, 1])
    assert ObjectModel.from_mesh(wedge(angle), settings=ModelSettings(crease_angle_deg=28)).edge_is_crease.sum() == 6 + creases


def test_smooth_sphere_keeps_every_edge_but_no_crease():
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    model = ObjectModel.from_mesh(sphere)
    assert len(model.edge_points) == len(sphere.edges_unique)
    assert not model.edge_is_crease.any()


def test_hollow_edges_are_kept_only_as_creases():
    grooved = trimesh.creation.revolve(np.array([[0, 0], [0.05, 0], [0.046, 0.02], [0.05, 0.04], [0, 0.04]]), sections=16)
    model = ObjectModel.from_mesh(grooved, settings=ModelSettings(crease_angle_deg=60))
    at_groove = (model.edge_points[..., 2] - 0.02).abs().amax(1) < 1e-6
    assert not at_groove.any()
    creased = ObjectModel.from_mesh(grooved, settings=ModelSettings(crease_angle_deg=15))
    assert ((creased.edge_points[..., 2] - 0.02).abs().amax(1) < 1e-6).sum() == 16


def test_silhouette_of_every_view_is_among_the_edges():
    """Edges between a front and a back face that can be seen are those a brute-force search over all edges finds."""
    mesh = trimesh.creation.torus(0.05, 0.02, major_sections=24, minor_sections=12)
    model = ObjectModel.from_mesh(mesh)
    for eye in np.random.default_rng(0).normal(size=(5, 3)):
        eye = 0.5 * eye / np.linalg.norm(eye)
        front = ((eye - mesh.triangles_center) * mesh.face_normals).sum(1) > 0
        change = front[mesh.face_adjacency[:, 0]] != front[mesh.face_adjacency[:, 1]]
        visible = change & mesh.face_adjacency_convex
        expected = mesh.vertices[mesh.face_adjacency_edges[visible]].mean(1)
        to_eye = torch.tensor(eye, dtype=torch.float32) - model.edge_points[:, 0]
        facing = (model.edge_normals * to_eye[:, None]).sum(-1) > 0
        middles = model.edge_points[facing[:, 0] != facing[:, 1]].mean(1).double().numpy()
        distance = np.linalg.norm(middles[:, None] - expected[None], axis=-1)
        assert distance.min(0).max() < 1e-6
        assert distance.min(1).max() < 1e-6


def test_seams_of_the_texture_are_no_borders():
    apart = cube()
    apart.unmerge_vertices()
    assert len(apart.vertices) == 36
    assert len(ObjectModel.from_mesh(apart).edge_points) == 12


def test_surface_samples_are_uniform_and_repeatable():
    model = ObjectModel.from_mesh(trimesh.creation.box((0.2, 0.1, 0.1)), settings=ModelSettings(surface_point_count=5000))
    assert model.surface_points.shape == model.surface_normals.shape == (5000, 3)
    half = torch.tensor([0.1, 0.05, 0.05])
    outward = (model.surface_points / half * model.surface_normals).sum(-1)
    torch.testing.assert_close(outward, torch.ones(5000))
    # Ends take 2 of the 10 squares of the box's surface.
    assert model.surface_normals[:, 0].abs().mean().item() == pytest.approx(0.2, abs=0.005)
    torch.testing.assert_close(model.surface_points.mean(0), torch.zeros(3), atol=2e-3, rtol=0)
    again = ObjectModel.from_mesh(trimesh.creation.box((0.2, 0.1, 0.1)), settings=ModelSettings(surface_point_count=5000))
    assert torch.equal(model.surface_points, again.surface_points)


def test_scene_is_flattened_with_its_transforms(tmp_path: Path):
    scene = trimesh.Scene()
    scene.add_geometry(cube())
    scene.add_geometry(cube(), transform=trimesh.transformations.translation_matrix([0.3, 0, 0]))
    scene.export(tmp_path / "two.glb")
    model = ObjectModel.from_file(tmp_path / "two.glb", name="pair")
    assert model.name == "pair"
    torch.testing.assert_close(model.centre, torch.tensor([0.15, 0, 0]))
    assert len(model.edge_points) == 24
    assert len(model.mesh.faces) == 24


def test_given_mesh_is_not_changed():
    mesh = cube(100)
    ObjectModel.from_mesh(mesh, unit="mm")
    np.testing.assert_allclose(mesh.extents, 100)


def test_missing_file(tmp_path: Path):
    with pytest.raises(MissingFileError, match=r"nothing\.ply' does not exist"):
        ObjectModel.from_file(tmp_path / "nothing.ply")


def test_unknown_suffix(tmp_path: Path):
    (tmp_path / "part.step").write_text("ISO-10303-21;")
    with pytest.raises(UnknownFormatError, match=r"\.ply, \.obj, \.stl, \.glb"):
        ObjectModel.from_file(tmp_path / "part.step")


@pytest.mark.parametrize("suffix", ["ply", "stl", "glb", "gltf", "off"])
@pytest.mark.parametrize("content", [b"", b"this is not a mesh at all\n"])
def test_undecodable_file(tmp_path: Path, suffix: str, content: bytes):
    (tmp_path / f"bad.{suffix}").write_bytes(content)
    with pytest.raises(ModelError, match=rf"bad\.{suffix}.*(export|Export)"):
        ObjectModel.from_file(tmp_path / f"bad.{suffix}")


def test_file_without_faces(tmp_path: Path):
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "cloud.ply")
    with pytest.raises(ModelError, match=r"no triangles.*from_polylines"):
        ObjectModel.from_file(tmp_path / "cloud.ply")
    with pytest.raises(ModelError, match="no triangles"):
        ObjectModel.from_mesh(trimesh.Trimesh())


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_vertices_that_are_not_finite(value: float):
    mesh = cube()
    mesh.vertices[3, 1] = value
    with pytest.raises(ModelError, match=r"1 of 8 vertices of 'box' are not finite"):
        ObjectModel.from_mesh(mesh, name="box")


def test_wrong_unit_says_which_would_fit():
    with pytest.raises(ModelError, match=r"173 m across with unit='m'; expected 5 mm to 5 m\. Plausible would be .*unit='mm' \(0\.173 m\)"):
        ObjectModel.from_mesh(cube(100), name="box")
    with pytest.raises(ModelError, match=r"0\.000173 m across with unit='mm'.*unit='m' \(0\.173 m\)"):
        ObjectModel.from_mesh(cube(0.1), name="box", unit="mm")
    with pytest.raises(ModelError, match="No known unit makes it plausible: set scale"):
        ObjectModel.from_mesh(cube(1e9), name="box")


def test_unknown_unit():
    with pytest.raises(ModelError, match=r"unknown unit 'furlong'.*m, cm, mm, inch"):
        Placement("furlong").metres(np.eye(3), "box")


def test_degenerate_and_repeated_faces_are_dropped_quietly():
    mesh = cube()
    corner = int(mesh.faces[0, 0])
    extra = [[corner, corner, int(mesh.faces[0, 1])], mesh.faces[0].tolist()]
    worse = trimesh.Trimesh(mesh.vertices, np.concatenate([mesh.faces, extra]), process=False)
    assert len(ObjectModel.from_mesh(worse).edge_points) == 12


def test_mesh_of_degenerate_faces_alone():
    flat = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(ModelError, match="all 1 faces of the mesh are degenerate"):
        ObjectModel.from_mesh(flat)


def assert_outward(model: ObjectModel) -> None:
    assert ((model.surface_points * model.surface_normals).sum(-1) > 0).all()
    assert len(model.edge_points) == 12
    assert model.mesh.volume == pytest.approx(SIDE**3)


def test_inverted_mesh_is_flipped():
    mesh = cube()
    mesh.invert()
    with pytest.warns(TorchtrackWarning, match="12 of 12 faces of 'box' point inwards"):
        model = ObjectModel.from_mesh(mesh, name="box")
    assert_outward(model)


def test_inverted_piece_is_flipped_alone():
    inverted = cube()
    inverted.apply_translation([0.3, 0, 0])
    inverted.invert()
    with pytest.warns(TorchtrackWarning, match="12 of 24 faces"):
        model = ObjectModel.from_mesh([cube(), inverted])
    assert model.mesh.volume == pytest.approx(2 * SIDE**3)


def test_open_mesh_inside_out_is_flipped():
    mesh = cube()
    mesh.update_faces(np.arange(12) >= 2)
    outward = ObjectModel.from_mesh(mesh)
    mesh.invert()
    with pytest.warns(TorchtrackWarning, match="10 of 10 faces"):
        model = ObjectModel.from_mesh(mesh)
    torch.testing.assert_close(model.surface_normals.mean(0), outward.surface_normals.mean(0), atol=0.02, rtol=0)


def test_contradicting_faces_are_mended():
    mesh = cube()
    faces = mesh.faces.copy()
    faces[[2, 7]] = faces[[2, 7], ::-1]
    with pytest.warns(TorchtrackWarning, match="2 of 12 faces of 'box' were wound against their neighbours"):
        model = ObjectModel.from_mesh(trimesh.Trimesh(mesh.vertices, faces, process=False), name="box")
    assert_outward(model)


def moebius(sections: int = 24) -> trimesh.Trimesh:
    turn = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    sides = [
        np.stack([(0.1 + w * np.cos(turn / 2)) * np.cos(turn), (0.1 + w * np.cos(turn / 2)) * np.sin(turn), w * np.sin(turn / 2)], 1)
        for w in (-0.02, 0.02)
    ]
    strip = [[i, i + sections, (i + 1), (i + 1) + sections] for i in range(sections - 1)] + [[sections - 1, 2 * sections - 1, sections, 0]]
    return trimesh.Trimesh(np.concatenate(sides), [face for a, b, c, d in strip for face in ([a, c, b], [b, c, d])], process=False)


def test_surface_with_one_side_is_kept_with_a_warning():
    with pytest.warns(TorchtrackWarning, match="contradict each other"):
        model = ObjectModel.from_mesh(moebius(), name="band")
    # The rim is drawn, and along every edge both normals show the same side.
    assert model.edge_is_crease.sum() >= 48
    smooth = ~model.edge_is_crease
    assert ((model.edge_normals[smooth, 0] * model.edge_normals[smooth, 1]).sum(-1) > 0).all()


def test_sheet_with_a_back_has_a_rim_and_no_diagonals():
    sheet = [[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]]
    model = ObjectModel.from_mesh(trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], sheet, process=False))
    torch.testing.assert_close(lengths(model), torch.full((4,), 0.1))
    assert model.edge_is_crease.all()


def textured_quad_obj(folder: Path, library: str = "card.mtl", image: str = "card.png") -> Path:
    text = (
        f"mtllib {library}\nusemtl card\nv 0 0 0\nv 0.1 0 0\nv 0.1 0.1 0\nv 0 0.1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    (folder / "card.obj").write_text(text)
    (folder / "card.mtl").write_text(f"newmtl card\nKd 1 1 1\nmap_Kd {image}\n")
    pattern = np.full((64, 64, 3), 230, np.uint8)
    pattern[:, :32] = 20
    Image.fromarray(pattern).save(folder / "card.png")
    return folder / "card.obj"


def test_obj_with_its_texture(tmp_path: Path):
    model = ObjectModel.from_file(textured_quad_obj(tmp_path))
    assert len(model.texture_points) > 20
    torch.testing.assert_close(model.texture_points[:, 0], torch.full((len(model.texture_points),), 0.05), atol=1e-5, rtol=0)


@pytest.mark.parametrize("names", [{"library": "gone.mtl"}, {"image": "gone.png"}])
def test_obj_that_names_a_missing_texture(tmp_path: Path, names: dict):
    path = textured_quad_obj(tmp_path, **names)
    with pytest.warns(TorchtrackWarning, match=r"names 'gone.*only the geometry is used.*export the model as GLB"):
        model = ObjectModel.from_file(path)
    assert len(model.edge_points) == 4
    assert len(model.texture_points) == 0


def test_ply_that_names_a_missing_texture(tmp_path: Path):
    text = cube().export(file_type="ply", encoding="ascii").decode()
    (tmp_path / "box.ply").write_text(text.replace("comment https", "comment TextureFile gone.png\ncomment https"))
    with pytest.warns(TorchtrackWarning, match=r"names 'gone\.png'"):
        assert len(ObjectModel.from_file(tmp_path / "box.ply").edge_points) == 12


def test_gltf_that_names_a_missing_texture(tmp_path: Path):
    files = cube().export(file_type="gltf")
    content = json.loads(files["model.gltf"]) | {"images": [{"uri": "gone.png"}, {"uri": "data:image/png;base64,"}]}
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "model.gltf").write_text(json.dumps(content))
    with pytest.warns(TorchtrackWarning, match=r"names 'gone\.png', which"):
        assert len(ObjectModel.from_file(tmp_path / "model.gltf").edge_points) == 12


@pytest.mark.parametrize("damage", ["image", "coordinates"])
def test_texture_that_cannot_be_read(tmp_path: Path, damage: str):
    card = ObjectModel.from_file(textured_quad_obj(tmp_path)).mesh
    content = card.export(file_type="glb")
    old, new = (b"\x89PNG\r\n", b"broken") if damage == "image" else (b'"TEXCOORD_0"', b'"TEXCOORD_7"')
    assert old in content
    (tmp_path / "card.glb").write_bytes(content.replace(old, new))
    with pytest.warns(TorchtrackWarning, match=r"the texture of '.*card\.glb' cannot be read: only the geometry"):
        assert len(ObjectModel.from_file(tmp_path / "card.glb").edge_points) == 4


@pytest.mark.parametrize(
    ("file", "creases", "edges"),
    [("lbracket_normal_lbracket.ply", 18, 18), ("satellite_normal_satellite.ply", 252, 252), ("cube_slow_cube.ply", 12, 12)],
)
def test_shared_models(data_dir: Path, file: str, creases: int, edges: int):
    model = ObjectModel.from_file(data_dir / "sequences" / file)
    assert (int(model.edge_is_crease.sum()), len(model.edge_points)) == (creases, edges)


def test_large_scan_loads_without_a_warning(data_dir: Path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = ObjectModel.from_file(data_dir / "sequences" / "bunny_normal_bunny.ply")
    assert 30_000 < len(model.edge_points) < 104_000
    assert model.diameter_m == pytest.approx(0.19, abs=1e-4)


def boxes(count: int) -> trimesh.Trimesh:
    """Boxes in a row that do not touch, one of which has a face wound wrongly."""
    box = trimesh.creation.box((1, 1, 1))
    vertices = (box.vertices[None] + 3.0 * np.arange(count)[:, None, None] * [1, 0, 0]).reshape(-1, 3)
    faces = (box.faces[None] + 8 * np.arange(count)[:, None, None]).reshape(-1, 3)
    faces[5] = faces[5, ::-1]
    return trimesh.Trimesh(vertices / (3.0 * count), faces, process=False)


def test_many_parts_are_turned_in_one_search():
    """Each part is searched from its own first face, and all of them in one search."""
    with pytest.warns(TorchtrackWarning, match="1 of 24000 faces of 'row' were wound against their neighbours"):
        model = ObjectModel.from_mesh(boxes(2000), name="row")
    assert len(model.edge_points) == 12 * 2000
    assert model.mesh.volume == pytest.approx(2000 / 6000**3, rel=1e-6)


@pytest.mark.parametrize("shift", [[448_262.0, 5_411_932, 120], [0, 0, -200]])
def test_model_far_from_its_origin_is_refused(shift: list[float]):
    far = cube().apply_translation(shift)
    away = rf"\({0 - shift[0]:.10g}, {0 - shift[1]:.10g}, .*\)"
    with pytest.raises(ModelError, match=rf"'far' lies .* times its diameter from its own origin.*centre to true, or move it by {away} m in a mesh"):
        ObjectModel.from_mesh(far, name="far")
    with pytest.raises(ModelError, match="from its own origin"):
        ObjectModel.from_polylines(np.asarray(far.vertices)[far.edges])


def test_model_some_way_from_its_origin_is_told():
    with pytest.warns(TorchtrackWarning, match=r"'away' lies 115 times its diameter from its own origin"):
        model = ObjectModel.from_mesh(cube().apply_translation([0, 20, 0]), name="away")
    torch.testing.assert_close(lengths(model), torch.full((12,), SIDE), atol=1e-5, rtol=0)


def test_what_is_no_file(tmp_path: Path):
    (tmp_path / "folder.ply").mkdir()
    os.mkfifo(tmp_path / "pipe.glb")
    for name, kind in (("folder.ply", "folder"), ("pipe.glb", "pipe or device")):
        with pytest.raises(MissingFileError, match=rf"{name}' is a {kind}, not a file"):
            ObjectModel.from_file(tmp_path / name)
    with pytest.raises(MissingFileError, match="cannot be opened"):
        ObjectModel.from_file(tmp_path / ("x" * 5000 + ".ply"))


def test_faces_that_name_no_vertex():
    with pytest.raises(ModelError, match=r"face 1 of 'box' names the vertices \[0, 1, 99\], and there are 3"):
        ObjectModel.from_mesh(trimesh.Trimesh(np.eye(3), [[0, 1, 2], [0, 1, 99]], process=False), name="box")
    with pytest.raises(ModelError, match="less than three coordinates"):
        ObjectModel.from_mesh(trimesh.Trimesh(np.eye(3)[:, :2], [[0, 1, 2]], process=False))


def test_coordinates_near_the_largest_number(tmp_path: Path):
    (tmp_path / "huge.obj").write_text("v 1e308 0 0\nv -1e308 1e308 0\nv 0 0 1e308\nf 1 2 3\n")
    with pytest.raises(ModelError, match="inf m across.*expected 5 mm to 5 m"):
        ObjectModel.from_file(tmp_path / "huge.obj")


def test_parts_without_faces_are_told():
    with pytest.warns(TorchtrackWarning, match="1 of 2 parts of 'pair' have no faces"):
        ObjectModel.from_mesh(trimesh.Scene([cube(), trimesh.PointCloud(np.eye(3))]), name="pair")
