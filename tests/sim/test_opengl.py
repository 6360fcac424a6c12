"""OpenGL draws what the rasteriser draws."""

import sys

import numpy as np
import pytest
import trimesh

from torchtrack.core.camera import Camera
from torchtrack.errors import MissingExtraError
from torchtrack.sim.background import BackgroundConfig
from torchtrack.sim.meshes import make_mesh
from torchtrack.sim.render import RenderConfig, Renderer, Scenery
from torchtrack.sim.surface import RenderObject, linear_to_srgb
from torchtrack.sim.trajectory import pose_matrix

CAMERA = Camera(300.0, 300.0, 79.5, 59.5, 160, 120)


@pytest.fixture(scope="module")
def needs_opengl():
    pytest.importorskip("numba", reason="the rasteriser needs numba: pip install 'torchtrack[sim]'")
    pytest.importorskip("moderngl", reason="OpenGL needs moderngl: pip install 'torchtrack[gl]'")
    from torchtrack.sim.opengl_drawer import open_context

    try:
        open_context().release()
    except MissingExtraError as error:
        pytest.skip(f"no OpenGL here: {error}")


def both(meshes, poses, scenery=None, **config):
    objects = [RenderObject.from_mesh(mesh) for mesh in meshes]
    background = BackgroundConfig(kind="messy").picture(160, 120)
    for backend in ("rasterizer", "opengl"):
        yield Renderer(objects, CAMERA, background, RenderConfig(backend=backend, **config)).render(np.stack(poses), scenery)


def coloured():
    mesh = trimesh.creation.icosphere(3, 0.05)
    mesh.visual.vertex_colors = np.column_stack([np.rint(255 * (mesh.vertices + 0.05) * 10).clip(0, 255), np.full(len(mesh.vertices), 255)])
    return mesh


@pytest.mark.usefixtures("needs_opengl")
@pytest.mark.parametrize("supersampling", [1, 3, 4])
@pytest.mark.parametrize(
    ("shapes", "z"),
    [
        (("book",), 0.5),
        (("torus_knot",), 0.5),
        (("mug", "cube"), 0.6),
        (("planar",), 0.4),
        (("sphere",), 0.4),
        (("planar",), 0.07),
    ],
)
def test_both_give_the_same_image(shapes, z, supersampling):
    meshes = [coloured() if name == "sphere" else make_mesh(name) for name in shapes]
    poses = [pose_matrix((-0.03 + 0.05 * i, 0.01, z + 0.04 * i), (20.0, 30.0, 10.0 + 40 * i)).numpy() for i in range(len(shapes))]
    drawn, of_gl = both(meshes, poses, supersampling=supersampling)
    difference = 255 * (linear_to_srgb(of_gl.luminance) - linear_to_srgb(drawn.luminance))
    assert np.abs(difference).mean() < 1
    assert of_gl.regions == drawn.regions
    same = of_gl.object_index == drawn.object_index
    assert same.mean() > 0.995
    inside = same & (drawn.object_index >= 0)
    assert inside.sum() > 500
    assert np.median(np.abs(of_gl.depth[inside] / drawn.depth[inside] - 1)) < 1e-4


@pytest.mark.usefixtures("needs_opengl")
def test_contours_agree_to_a_tenth_of_a_pixel():
    """Where the outline of a white square crosses each row, by how much of the row is white."""
    square = trimesh.Trimesh([[-0.05, -0.05, 0], [0.05, -0.05, 0], [0.05, 0.05, 0], [-0.05, 0.05, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    T = [pose_matrix((0.003, 0.001, 0.4), (10.0, -20.0, 12.0)).numpy()]
    dark = Scenery(np.zeros((120, 160), np.float32))
    drawn, of_gl = both([square], T, dark, ambient=1.0, diffuse=0.0, supersampling=4)
    widths = [frame.luminance.sum(1) / frame.luminance.max() for frame in (drawn, of_gl)]
    assert np.abs(widths[0] - widths[1]).max() < 0.1
    left = [(frame.luminance[:, :80].sum(1) / frame.luminance.max())[45:75] for frame in (drawn, of_gl)]
    assert left[0].min() > 10
    assert np.abs(left[0] - left[1]).max() < 0.1


def test_without_moderngl_the_error_names_the_extra(monkeypatch):
    monkeypatch.delitem(sys.modules, "torchtrack.sim.opengl_drawer", raising=False)
    monkeypatch.setitem(sys.modules, "moderngl", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'torchtrack\[gl\]'"):
        list(both([make_mesh("bar")], [np.eye(4)]))[1]


@pytest.mark.usefixtures("needs_opengl")
def test_without_egl_the_error_says_so(monkeypatch):
    from torchtrack.sim import opengl_drawer

    def broken(**settings):
        raise Exception("no display")

    monkeypatch.setattr(opengl_drawer.moderngl, "create_context", broken)
    with pytest.raises(MissingExtraError, match="no EGL here"):
        opengl_drawer.open_context()
