"""Edges of textures and colours: the right place in 3D, and only where there is an edge of the print."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from torchtrack.core.lie import transform_points
from torchtrack.errors import ModelError, TorchtrackWarning
from torchtrack.io import read_sequence
from torchtrack.object_model import ModelSettings, ObjectModel
from torchtrack.object_model.image_edges import image_edges
from torchtrack.object_model.surface_points import SurfacePoints, thin_out

SIZE = 0.1
TEXELS = 200
TEXEL_M = SIZE / TEXELS
QUAD = np.array([[0, 0, 0], [SIZE, 0, 0], [SIZE, SIZE, 0], [0, SIZE, 0]])
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def card(image: np.ndarray, uv: np.ndarray = UV, vertices: np.ndarray = QUAD, faces: np.ndarray = FACES) -> trimesh.Trimesh:
    """A square card of 10 cm, its normal along z, with an image ``[h, w]`` on it: u along x, v along y."""
    picture = Image.fromarray(np.repeat(image.astype(np.uint8)[..., None], 3, 2))
    return trimesh.Trimesh(vertices, faces, visual=TextureVisuals(uv, material=PBRMaterial(baseColorTexture=picture)), process=False)


def two_tone(columns: int = 60, dark: int = 30, bright: int = 220) -> np.ndarray:
    """Dark in the first columns, bright in the rest: one upright edge, at ``columns`` texels from the left."""
    image = np.full((TEXELS, TEXELS), bright)
    image[:, :columns] = dark
    return image


def disc(centre: tuple[float, float], radius: float, supersampling: int = 8) -> np.ndarray:
    """A dark disc on white, smooth at its rim; centre (u, v) and radius in texels from the image's upper left corner."""
    at = (np.arange(TEXELS * supersampling) + 0.5) / supersampling
    inside = (at[None] - centre[0]) ** 2 + (at[:, None] - centre[1]) ** 2 < radius**2
    share = inside.reshape(TEXELS, supersampling, TEXELS, supersampling).mean((1, 3))
    return np.round(255 - 200 * share)


@pytest.mark.parametrize("columns", [60, 61, 137])
def test_upright_edge_is_where_it_is_printed(columns: int):
    model = ObjectModel.from_mesh(card(two_tone(columns)))
    assert len(model.texture_points) > 100
    torch.testing.assert_close(model.texture_points[:, 0], torch.full((len(model.texture_points),), columns * TEXEL_M), atol=0.02 * TEXEL_M, rtol=0)
    assert model.texture_points[:, 2].abs().max() < 1e-8
    # The whole edge is covered, but for a margin at the border of the card.
    assert model.texture_points[:, 1].amin() < 5 * TEXEL_M
    assert model.texture_points[:, 1].amax() > SIZE - 5 * TEXEL_M


def test_tangents_keep_the_brighter_side_on_their_left():
    for image, sign in ((two_tone(), 1.0), (250 - two_tone(), -1.0)):
        model = ObjectModel.from_mesh(card(image))
        count = len(model.texture_points)
        torch.testing.assert_close(model.texture_normals, torch.tensor([0, 0, 1.0]).expand(count, 3))
        towards_bright = torch.linalg.cross(model.texture_normals, model.texture_tangents)
        torch.testing.assert_close(towards_bright, torch.tensor([sign, 0, 0]).expand(count, 3), atol=1e-3, rtol=0)


def test_v_runs_up():
    """An edge at a quarter of the image's height from its top lies at three quarters of the card."""
    model = ObjectModel.from_mesh(card(two_tone(50).T))
    torch.testing.assert_close(model.texture_points[:, 1], torch.full((len(model.texture_points),), 0.075), atol=0.02 * TEXEL_M, rtol=0)


@pytest.mark.parametrize("centre", [(100.0, 100.0), (83.3, 121.7)])
def test_disc_to_sub_texel_precision(centre: tuple[float, float]):
    model = ObjectModel.from_mesh(card(disc(centre, 40.0)))
    middle = torch.tensor([centre[0], TEXELS - centre[1]]) * TEXEL_M
    offset = model.texture_points[:, :2] - middle
    error = offset.norm(dim=1) / TEXEL_M - 40
    # A step in the light is blurred by the printer's texels before its logarithm is taken, which moves it to the dark side.
    assert (error - error.median()).abs().max() < 0.25
    assert error.abs().max() < 0.5
    centre_error = (model.texture_points[:, :2].amax(0) + model.texture_points[:, :2].amin(0)) / 2 - middle
    assert centre_error.abs().max() < 0.1 * TEXEL_M
    assert ((model.texture_tangents[:, :2] * offset / offset.norm(dim=1, keepdim=True)).sum(1)).abs().max() < 0.1


def test_points_are_evenly_spaced():
    model = ObjectModel.from_mesh(card(disc((100, 100), 60)))
    points = model.texture_points.double()
    gap = torch.cdist(points, points).fill_diagonal_(1).amin(1)
    spacing = 0.0025 * model.diameter_m
    assert gap.min() >= spacing * 0.999
    assert gap.max() < 2.5 * spacing


@pytest.mark.parametrize("most", [0, 50, 200])
def test_number_of_points_is_limited(most: int):
    settings = ModelSettings(max_texture_points=most)
    image = np.kron((np.indices((8, 8)).sum(0) % 2) * 200 + 20, np.ones((25, 25)))
    model = ObjectModel.from_mesh(card(image), settings=settings)
    assert most * 0.5 <= len(model.texture_points) <= most
    again = ObjectModel.from_mesh(card(image), settings=settings)
    assert torch.equal(model.texture_points, again.texture_points)
    if most:
        quadrant = (model.texture_points[:, :2] > SIZE / 2).float()
        assert (quadrant.mean(0) - 0.5).abs().max() < 0.15


@pytest.mark.parametrize(("bright", "has_edges"), [(120, True), (72, False)])
def test_contrast_decides(bright: int, has_edges: bool):
    expected_warning = (
        nullcontext() if has_edges else pytest.warns(TorchtrackWarning, match=r"gives no edges.*differ by 0\.5 in log luminance.*texture_contrast")
    )
    with expected_warning:
        model = ObjectModel.from_mesh(card(two_tone(dark=60, bright=bright)))
    assert (len(model.texture_points) > 0) == has_edges
    assert len(ObjectModel.from_mesh(card(two_tone(dark=60, bright=72)), settings=ModelSettings(texture_contrast=0.1)).texture_points) > 0


def test_mirrored_map():
    """Printed the other way round: the edge moves, and the brighter side is still told right."""
    model = ObjectModel.from_mesh(card(two_tone(60), uv=UV * [-1, 1] + [1, 0]))
    torch.testing.assert_close(model.texture_points[:, 0], torch.full((len(model.texture_points),), SIZE - 60 * TEXEL_M), atol=1e-5, rtol=0)
    assert (torch.linalg.cross(model.texture_normals, model.texture_tangents)[:, 0] < -0.99).all()


def test_map_that_repeats_the_texture():
    model = ObjectModel.from_mesh(card(two_tone(60), uv=UV * 2), settings=ModelSettings(max_texture_points=2000))
    columns = model.texture_points[:, 0].unique()
    expected = torch.tensor([60, 260]) * TEXEL_M / 2
    assert (columns[:, None] - expected).abs().amin(1).max() < 0.02 * TEXEL_M
    for tile in range(2):
        rows = model.texture_points[(model.texture_points[:, 0] - expected[tile]).abs() < 1e-4, 1]
        assert rows.amin() < 0.005
        assert rows.amax() > 0.095


def test_faces_that_share_one_print():
    """The same picture on all sides of a box: every side carries its edges."""
    sides = trimesh.util.concatenate([trimesh.Trimesh(QUAD, FACES, process=False).apply_transform(T) for T in _sides()])
    box = card(disc((100, 100), 40), uv=np.tile(UV, (6, 1)), vertices=np.asarray(sides.vertices), faces=np.asarray(sides.faces))
    model = ObjectModel.from_mesh(box)
    for axis in range(3):
        for sign in (-1, 1):
            assert (model.texture_normals[:, axis] * sign > 0.99).sum() > 200


def _sides() -> list[np.ndarray]:
    to_centre = trimesh.transformations.translation_matrix([-SIZE / 2, -SIZE / 2, SIZE / 2])
    turns = [([1, 0, 0], 0), ([1, 0, 0], 90), ([1, 0, 0], 180), ([1, 0, 0], 270), ([0, 1, 0], 90), ([0, 1, 0], 270)]
    return [trimesh.transformations.rotation_matrix(np.deg2rad(angle), axis) @ to_centre for axis, angle in turns]


def test_border_of_an_island_is_no_edge():
    """A bright card cut from the middle of a dark image: nothing is printed on it."""
    image = np.full((TEXELS, TEXELS), 20)
    image[50:150, 50:150] = 230
    with pytest.warns(TorchtrackWarning, match=r"the texture of 'object' gives no edges.*borders of its UV islands"):
        assert len(ObjectModel.from_mesh(card(image, uv=UV * 0.5 + 0.25)).texture_points) == 0
    # Two islands that touch, one dark and one bright.
    other = QUAD + np.array([0, 0, 0.05])
    pair = card(
        two_tone(100),
        uv=np.concatenate([UV * [0.5, 1], UV * [0.5, 1] + [0.5, 0]]),
        vertices=np.concatenate([QUAD, other]),
        faces=np.concatenate([FACES, FACES + 4]),
    )
    with pytest.warns(TorchtrackWarning, match="gives no edges"):
        assert len(ObjectModel.from_mesh(pair).texture_points) == 0


def test_several_textures_in_one_file(tmp_path: Path):
    scene = trimesh.Scene()
    scene.add_geometry(card(two_tone(60)))
    scene.add_geometry(card(two_tone(140).T), transform=trimesh.transformations.translation_matrix([0, 0, 0.2]))
    scene.export(tmp_path / "cards.glb")
    model = ObjectModel.from_file(tmp_path / "cards.glb")
    lower = model.texture_points[:, 2] < 0.1
    torch.testing.assert_close(model.texture_points[lower, 0], torch.full((int(lower.sum()),), 0.03), atol=1e-5, rtol=0)
    torch.testing.assert_close(model.texture_points[~lower, 1], torch.full((int((~lower).sum()),), 0.03), atol=1e-5, rtol=0)
    assert len(model.mesh.faces) == 4
    assert model.mesh.visual.kind == "texture"


def test_fine_texture_is_worked_on_at_a_coarser_scale():
    fine = np.kron(two_tone(60), np.ones((8, 8)))
    model = ObjectModel.from_mesh(card(fine))
    assert len(model.texture_points) > 100
    torch.testing.assert_close(model.texture_points[:, 0], torch.full((len(model.texture_points),), 0.03), atol=0.1 * TEXEL_M, rtol=0)


def test_units_apply_to_the_texture():
    model = ObjectModel.from_mesh(card(two_tone(60), vertices=QUAD * 1000), unit="mm")
    torch.testing.assert_close(model.texture_points[:, 0], torch.full((len(model.texture_points),), 0.03), atol=1e-5, rtol=0)


def test_texture_coordinates_without_an_image():
    plain = trimesh.Trimesh(QUAD, FACES, visual=TextureVisuals(UV, material=SimpleMaterial()), process=False)
    assert len(ObjectModel.from_mesh(plain).texture_points) == 0


def test_image_edges_of_a_slanted_step():
    angle, offset = np.deg2rad(25), 2.3
    normal = np.array([np.cos(angle), np.sin(angle)])
    v, u = np.mgrid[:80, :80]
    distance = (u - 40) * normal[0] + (v - 40) * normal[1] - offset
    edges = image_edges(np.clip(distance + 0.5, 0, 1), blur_px=1.5, contrast=0.5)
    inner = (np.abs(edges.pixels - 40) < 30).all(1)
    assert np.abs((edges.pixels[inner] - 40) @ normal - offset).max() < 0.05
    np.testing.assert_allclose(edges.gradients[inner], np.tile(normal, (inner.sum(), 1)), atol=0.03)


def test_thinning_keeps_both_sides_of_a_stroke():
    y = np.arange(0, 0.1, 0.001)
    points = np.concatenate([np.stack([np.full_like(y, x), y, 0 * y], 1) for x in (0, 0.001)])
    tangents = np.repeat([[0, 1.0, 0], [0, -1.0, 0]], len(y), 0)
    thin = thin_out(SurfacePoints(points, tangents, np.tile([0, 0, 1.0], (len(points), 1)), 0.2), spacing_m=0.0055, max_points=1000)
    assert (thin.points[:, 0] == 0).sum() == (thin.points[:, 0] > 0).sum() == 17


def test_colours_of_faces():
    """The two halves of a card: their border is an edge, the diagonals are not."""
    vertices = np.concatenate([QUAD, QUAD[1:3] + np.array([SIZE, 0, 0])])
    faces = np.concatenate([FACES, [[1, 4, 5], [1, 5, 2]]])
    colours = np.array([[20, 20, 20, 255]] * 2 + [[230, 230, 230, 255]] * 2, dtype=np.uint8)
    model = ObjectModel.from_mesh(trimesh.Trimesh(vertices, faces, face_colors=colours, process=False))
    assert len(model.texture_points) > 50
    torch.testing.assert_close(model.texture_points[:, 0], torch.full((len(model.texture_points),), SIZE), atol=1e-6, rtol=0)
    assert (torch.linalg.cross(model.texture_normals, model.texture_tangents)[:, 0] > 0.99).all()


def test_colours_of_materials():
    """Parts with a plain colour each meet along an edge."""
    parts = [
        trimesh.Trimesh(QUAD + np.array([x, 0, 0]), FACES, visual=TextureVisuals(UV, material=SimpleMaterial(diffuse=[c, c, c, 255])), process=False)
        for x, c in ((0, 20), (SIZE, 230))
    ]
    model = ObjectModel.from_mesh(parts)
    assert len(model.texture_points) > 50
    assert (model.texture_points[:, 0] - SIZE).abs().max() < 1e-6


@pytest.mark.parametrize(("cells", "has_edges"), [(100, True), (4, False)])
def test_colours_of_vertices(cells: int, has_edges: bool):
    """A change between neighbouring vertices is an edge if they are near, a shade if they are far."""
    at = np.linspace(0, SIZE, cells + 1)
    grid = np.stack([*np.meshgrid(at, at, indexing="ij"), np.zeros((cells + 1, cells + 1))], -1).reshape(-1, 3)
    first = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1)
    faces = np.concatenate([np.stack([first, first + cells + 1, first + cells + 2], 1), np.stack([first, first + cells + 2, first + 1], 1)])
    grey = np.where(grid[:, 0] < 0.06 - 1e-9, 20, 230).astype(np.uint8)
    model = ObjectModel.from_mesh(trimesh.Trimesh(grid, faces, vertex_colors=np.stack([grey] * 3, 1), process=False))
    assert (len(model.texture_points) > 0) == has_edges
    if has_edges:
        torch.testing.assert_close(model.texture_points[:, 0], torch.full((len(model.texture_points),), 0.0595), atol=1e-6, rtol=0)
        assert model.texture_points[:, 1].amin() < 0.002
        assert model.texture_points[:, 1].amax() > 0.098


@pytest.mark.parametrize(("sequence", "label"), [("book_normal", "book"), ("cube_slow", "cube"), ("three_normal", "cube")])
def test_print_lies_on_the_events(data_dir: Path, sequence: str, label: str):
    """Texture points at the true pose lie on events of the next milliseconds, to less than a pixel."""
    sequence_read = read_sequence(data_dir / "sequences" / f"{sequence}.npz")
    thing = next(thing for thing in sequence_read.objects if thing.label == label)
    model = ObjectModel.from_file(thing.model_path("textured"))
    events = next(iter(sequence_read.events.chunks(max_events=120_000)))
    middle = len(events.t_us) // 2
    t_us = events.t_us[middle : middle + 1]
    near = (events.t_us - t_us).abs() < 5000
    T = thing.ground_truth.at(t_us)[0]
    points = transform_points(T, model.texture_points.double())
    normals = model.texture_normals.double() @ T[:3, :3].T
    front = ((normals * points).sum(-1) / points.norm(dim=-1)) < -0.3
    pixels = (points[front] @ torch.from_numpy(sequence_read.camera.matrix).T).double()
    pixels = pixels[:, :2] / pixels[:, 2:]
    where = torch.stack([events.x[near], events.y[near]], -1).double()
    distance = torch.cdist(pixels, where).amin(1)
    assert front.sum() > 300
    assert distance.median() < 1
    assert (distance < 2).double().mean() > 0.85


def test_coordinates_that_are_broken_are_told():
    """Hundreds of repeats, numbers beyond any image, NaN: no texture, and no negative ranges."""
    for bad in (UV * 4095, UV * [1e30, -1e30], UV * np.nan, UV * 1e300, UV * 0 + 0.3):
        with pytest.warns(TorchtrackWarning, match=r"the texture of 'object' gives no edges.*texture coordinates \(UV\)"):
            assert len(ObjectModel.from_mesh(card(two_tone(60), uv=bad)).texture_points) == 0


def test_print_on_very_many_faces_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("torchtrack.object_model.texture_edges._MOST_CANDIDATES", 100)
    with pytest.raises(ModelError, match=r"about .* points, expected at most 100.*max_texture_points: 0"):
        ObjectModel.from_mesh(card(two_tone(60)))


def test_no_texture_wanted_is_no_texture_lost():
    assert len(ObjectModel.from_mesh(card(two_tone(dark=60, bright=72)), settings=ModelSettings(max_texture_points=0)).texture_points) == 0
