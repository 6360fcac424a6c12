import sys

import cv2
import numpy as np
import pytest
import trimesh

import torchtrack.sim
from torchtrack.core.camera import Camera
from torchtrack.errors import CalibrationError, ConfigError, MissingExtraError, ModelError, PoseError
from torchtrack.sim.drawing import Region, merge_regions, sample_offsets
from torchtrack.sim.meshes import SHAPES, make_mesh
from torchtrack.sim.render import RenderConfig, Renderer, plain_background
from torchtrack.sim.surface import RenderObject, corner_normals, grey_reflectance, linear_to_srgb, srgb_to_linear
from torchtrack.sim.textures import letter

CAMERA = Camera(200.0, 190.0, 31.3, 23.8, 64, 48)
# Every surface shows its reflectance, whatever its normal.
EVEN_LIGHT = RenderConfig(ambient=1.0, diffuse=0.0)


@pytest.fixture(scope="module", autouse=True)
def _numba():
    pytest.importorskip("numba", reason="the rasteriser needs numba: pip install 'torchtrack[sim]'")


def pose(x=0.0, y=0.0, z=1.0, rotation=None):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    if rotation is not None:
        T[:3, :3] = rotation
    return T


def rotation_y(angle):
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def square(half=0.05, reflectance=1.0, texture=None):
    """A square in the plane z = 0 that faces the camera, gloss off."""
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    image = np.ones((1, 1)) if texture is None else texture
    return RenderObject(
        corners[faces], np.broadcast_to([0.0, 0.0, -1.0], (2, 3, 3)).copy(), uv[faces], np.full((2, 3), reflectance), image, gloss=0.0
    )


def draw(objects, poses, camera=CAMERA, background=0.0, config=EVEN_LIGHT):
    image = background if isinstance(background, np.ndarray) else plain_background(camera.width, camera.height, background)
    return Renderer(objects, camera, image, config).render(np.stack(poses))


@pytest.mark.parametrize("offset", [0.0, 0.0003, 0.0011, 0.0017, 0.0024])
@pytest.mark.parametrize("blur", [0.0, 0.5])
def test_edges_of_a_square_are_where_they_belong(offset, blur):
    frame = draw([square()], [pose(offset, -offset)], config=EVEN_LIGHT.model_copy(update={"lens_blur_px": blur}))
    row, column = frame.luminance[24], frame.luminance[:, 31]
    # Light sums up to the way from the edge to the middle: pixel 31 reaches to 31.5, pixel 24 to 24.5.
    left, right = 31.5 - row[:32].sum(), 31.5 + row[32:].sum()
    top, bottom = 24.5 - column[:25].sum(), 24.5 + column[25:].sum()
    assert left == pytest.approx(CAMERA.cx + 200 * (offset - 0.05), abs=0.05)
    assert right == pytest.approx(CAMERA.cx + 200 * (offset + 0.05), abs=0.05)
    assert top == pytest.approx(CAMERA.cy + 190 * (-offset - 0.05), abs=0.05)
    assert bottom == pytest.approx(CAMERA.cy + 190 * (-offset + 0.05), abs=0.05)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_samples_fall_into_different_columns_and_rows(n):
    offsets = sample_offsets(n)
    assert offsets.shape == (n * n, 2)
    assert np.abs(offsets).max() < 0.5
    for axis in (0, 1):
        assert np.sort(offsets[:, axis]) == pytest.approx((np.arange(n * n) + 0.5) / n**2 - 0.5)


def test_texture_is_perspective_correct():
    texture = np.concatenate([np.zeros((64, 64)), np.ones((64, 64))], 1)
    angle = 0.9
    frame = draw([square(half=0.1, texture=texture)], [pose(z=0.6, rotation=rotation_y(angle))], background=0.0)
    # The border of the print is the object's middle line; affine texturing would put it half-way between the edges.
    x, z = 0.1 * np.cos(angle), 0.6 - 0.1 * np.sin(angle)
    right, middle = CAMERA.cx + 200 * x / z, CAMERA.cx
    assert frame.luminance[24, 20:].sum() == pytest.approx(right - middle, abs=0.1)
    affine = (right + CAMERA.cx - 200 * x / (0.6 + 0.1 * np.sin(angle))) / 2
    assert abs(affine - middle) > 2


def test_nearer_object_hides_the_other():
    far, near = square(half=0.2, reflectance=0.4), square(half=0.02, reflectance=0.9)
    for order in ([0, 1], [1, 0]):
        objects, poses = [far, near], [pose(z=1.2), pose(z=0.8)]
        frame = draw([objects[i] for i in order], [poses[i] for i in order], background=0.1)
        assert frame.luminance[24, 31] == pytest.approx(0.9, abs=1e-5)
        assert frame.luminance[24, 20] == pytest.approx(0.4, abs=1e-5)
        assert frame.object_index[24, 31] == order.index(1)
        assert frame.object_index[24, 20] == order.index(0)
        assert frame.depth[24, 31] == pytest.approx(0.8, rel=1e-5)


def test_depth_is_that_of_the_surface_at_the_centre_of_the_pixel():
    frame = draw([square(half=0.1)], [pose(z=0.7, rotation=rotation_y(0.7))])
    inside = np.zeros((48, 64), dtype=bool)
    inside[10:38, 20:40] = True
    normal = rotation_y(0.7) @ [0, 0, 1]
    v, u = np.nonzero(inside)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))], 1)
    assert frame.depth[inside] == pytest.approx(0.7 * normal[2] / (rays @ normal), rel=1e-5)
    assert np.isinf(frame.depth[0, 0])
    assert frame.object_index[0, 0] == -1


def test_a_surface_through_the_camera_plane_is_cut_not_folded():
    """A floor 0.1 m below the camera, from behind it to far ahead."""
    floor = RenderObject.from_mesh(trimesh.creation.box((40, 0.002, 40)), reflectance=0.5, gloss=0.0)
    frame = draw([floor], [pose(y=0.101, z=0)], background=0.1)
    horizon = CAMERA.cy + 190 * 0.1 / 20
    assert np.isfinite(frame.luminance).all()
    assert frame.luminance[int(horizon) + 3 :] == pytest.approx(0.5, abs=1e-4)
    assert frame.luminance[: int(horizon) - 3] == pytest.approx(0.1, abs=1e-4)
    below = 44
    assert frame.depth[below, 5] == pytest.approx(0.1 * 190 / (below - CAMERA.cy), rel=1e-3)


def test_objects_behind_the_camera_or_outside_of_the_image_are_not_drawn():
    frame = draw([square(), square()], [pose(z=-1.0), pose(x=2.0)], background=0.3)
    assert frame.regions == ()
    assert (frame.luminance == np.float32(0.3)).all()


def test_slivers_and_degenerate_faces_leave_no_trace():
    rng = np.random.default_rng(0)
    corners = rng.uniform(-0.1, 0.1, (400, 3, 3))
    corners[:100, 2] = corners[:100, 1]  # no area
    corners[100:200, 2] = corners[100:200, 1] + 1e-9 * rng.normal(size=(100, 3))
    corners[200:300, 2] = 0.5 * (corners[200:300, 0] + corners[200:300, 1]) + 1e-12
    corners[300:] *= [1, 1, 0]
    corners[300:, :, 0] = 0.02  # seen edge-on, from x = 0
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(1200).reshape(-1, 3), process=False)
    frame = draw([RenderObject.from_mesh(mesh), square(0.02)], [pose(z=0.5), pose(z=0.9)], config=RenderConfig())
    assert np.isfinite(frame.luminance).all()
    assert frame.luminance.min() >= 0
    assert frame.luminance.max() < 1.5
    assert (frame.depth > 0.3).all()


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (-0.14, 0.0), (0.13, 0.11), (0.0, -0.1)])
def test_what_is_drawn_in_a_region_is_what_the_whole_would_be(x, y):
    """Lens blur of the sharp image as a whole, image borders included."""
    rng = np.random.default_rng(1)
    background = rng.uniform(0.1, 0.9, (48, 64)).astype(np.float32)
    texture = rng.uniform(0, 1, (16, 16))
    poses = [pose(x, y)]
    sharp = draw([square(0.04, texture=texture)], poses, background=background, config=EVEN_LIGHT.model_copy(update={"lens_blur_px": 0.0}))
    frame = draw([square(0.04, texture=texture)], poses, background=background, config=EVEN_LIGHT.model_copy(update={"lens_blur_px": 0.5}))
    whole = cv2.GaussianBlur(sharp.luminance, (5, 5), 0.5, borderType=cv2.BORDER_REPLICATE)
    assert frame.luminance == pytest.approx(whole, abs=1e-6)
    assert frame.regions[0] != Region(0, 48, 0, 64)


def test_overlapping_regions_are_joined():
    regions = [Region(0, 10, 0, 10), Region(20, 30, 20, 30), Region(8, 22, 8, 22), Region(40, 45, 0, 5)]
    assert set(merge_regions(regions)) == {Region(0, 30, 0, 30), Region(40, 45, 0, 5)}
    assert merge_regions([Region(0, 5, 0, 5), Region(5, 9, 0, 5)]) == (Region(0, 5, 0, 5), Region(5, 9, 0, 5))


def test_light_falls_with_the_angle_and_lights_both_sides():
    config = RenderConfig(ambient=0.2, diffuse=0.8, light_direction=(0, 0, -1), lens_blur_px=0)
    for angle in (0.0, 0.6, np.pi, np.pi + 0.6):
        frame = draw([square(reflectance=0.5)], [pose(rotation=rotation_y(angle))], config=config)
        assert frame.luminance[24, 31] == pytest.approx(0.5 * (0.2 + 0.8 * abs(np.cos(angle))), abs=1e-4)


def test_highlight_appears_where_the_light_is_mirrored():
    config = RenderConfig(ambient=0.0, diffuse=0.0, light_direction=(0, 0, -1))
    plate = RenderObject.from_mesh(trimesh.creation.box((0.4, 0.3, 0.01)), gloss=0.7)
    frame = draw([plate], [pose()], config=config)
    assert frame.luminance[24, 31] == pytest.approx(0.7, abs=0.01)
    assert frame.luminance[24, 2] < 0.68


def test_normals_are_smooth_on_curves_and_flat_on_boxes():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    corners = sphere.vertices[sphere.faces]
    assert np.abs(corner_normals(corners, 30.0) - corners).max() < 0.02
    box = make_mesh("cube")
    normals = corner_normals(box.vertices[box.faces], 30.0)
    assert np.sort(np.abs(normals), -1) == pytest.approx(np.broadcast_to([0.0, 0.0, 1.0], normals.shape))
    cylinder = trimesh.creation.cylinder(1, 2, sections=64)
    normals = corner_normals(cylinder.vertices[cylinder.faces], 30.0)
    # Smooth around, sharp at the rims.
    assert np.minimum(np.abs(normals[..., 2]), 1 - np.abs(normals[..., 2])).max() < 1e-6


def test_vertex_colours_are_drawn():
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    mesh.visual.vertex_colors = np.tile([128, 128, 128, 255], (8, 1))
    frame = draw([RenderObject.from_mesh(mesh, gloss=0.0)], [pose()])
    assert frame.luminance[24, 31] == pytest.approx(float(srgb_to_linear(np.array(128 / 255.0))), rel=1e-3)


def test_srgb_goes_to_light_and_back():
    values = np.linspace(0, 1, 50)
    assert linear_to_srgb(srgb_to_linear(values)) == pytest.approx(values, abs=1e-6)
    assert grey_reflectance(np.array([[255, 255, 255, 0], [0, 0, 0, 255]], dtype=np.uint8)) == pytest.approx([1, 0])


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_closed_centred_and_wound_outwards(name):
    mesh = make_mesh(name, scale=0.5)
    welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    assert welded.is_winding_consistent
    assert welded.is_watertight
    assert mesh.volume > 0
    assert (0.05 if name != "finger" else 0.03) < mesh.extents.max() < (0.13 if name != "bar" else 0.3)
    assert np.abs(mesh.bounds.mean(0)).max() < 0.03
    if name in ("cube", "book", "satellite", "planar"):
        assert mesh.visual.material.baseColorTexture is not None
        assert mesh.visual.uv.min() > 0
        assert mesh.visual.uv.max() < 1


def test_every_face_of_the_cube_has_another_print():
    cube = make_mesh("cube")
    prints = [np.asarray(cube.visual.uv)[4 * i : 4 * i + 4].mean(0) for i in range(6)]
    assert len({tuple(np.round(middle, 3)) for middle in prints}) == 6


def test_prints_are_upright_and_not_mirrored():
    """The letter on the +y face of the cube, seen from there with the object's z upwards."""
    towards_y = np.array([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]])
    # The face is 406 * 0.12 / 0.84 = 58 px wide.
    camera = Camera(406.0, 406.0, 31.5, 31.5, 64, 64)
    frame = draw([RenderObject.from_mesh(make_mesh("cube"), gloss=0.0)], [pose(z=0.9, rotation=towards_y)], camera)
    inside = (slice(14, 44), slice(14, 44))  # the letter without its frame
    seen = frame.luminance[3:61, 3:61][inside].ravel()
    printed = cv2.resize(srgb_to_linear(letter(256) / 255.0).astype(np.float32), (58, 58), interpolation=cv2.INTER_AREA)
    agreement = [np.corrcoef(image[inside].ravel(), seen)[0, 1] for image in (printed, printed[:, ::-1], printed[::-1], printed[::-1, ::-1])]
    # An R has much in common with its mirror image.
    assert agreement[0] > 0.97
    assert max(agreement[1:]) < agreement[0] - 0.08


def test_unknown_shapes_and_bad_inputs_are_errors():
    with pytest.raises(ConfigError, match="unknown shape 'teapot': use one of cube"):
        make_mesh("teapot")
    with pytest.raises(ModelError, match="0 faces"):
        RenderObject.from_mesh(trimesh.Trimesh(np.zeros((3, 3)), np.zeros((0, 3), dtype=int)))
    broken = trimesh.Trimesh(np.array([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]]), [[0, 1, 2]], process=False)
    with pytest.raises(ModelError, match="finite"):
        RenderObject.from_mesh(broken)
    with pytest.raises(ModelError, match="at least one object"):
        Renderer([], CAMERA, plain_background(64, 48, 0.1))
    with pytest.raises(CalibrationError, match="64x48, got 48x64"):
        Renderer([square()], CAMERA, plain_background(48, 64, 0.1))
    with pytest.raises(CalibrationError, match="finite and not negative"):
        Renderer([square()], CAMERA, plain_background(64, 48, -0.1))
    lens = Camera(200.0, 200.0, 32.0, 24.0, 64, 48, "plumb_bob", (0.1, 0.0, 0.0, 0.0))
    with pytest.raises(CalibrationError, match="'plumb_bob' distortion"):
        Renderer([square()], lens, plain_background(64, 48, 0.1))
    with pytest.raises(PoseError, match="one finite pose per object"):
        draw([square()], [pose(), pose()])
    with pytest.raises(PoseError, match="one finite pose per object"):
        draw([square()], [pose(z=float("nan"))])


def test_without_numba_the_error_names_the_extra(monkeypatch):
    for name in ("rasterizer", "shading", "raster_drawer"):
        monkeypatch.delitem(sys.modules, f"torchtrack.sim.{name}", raising=False)
        monkeypatch.delattr(torchtrack.sim, name, raising=False)
    monkeypatch.delitem(sys.modules, "torchtrack.backends.numba.compiler", raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'torchtrack\[sim\]'"):
        Renderer([square()], CAMERA, plain_background(64, 48, 0.1))
