"""What is said of a model: sizes, units, surface, edges, texture, symmetries."""

import json

import numpy as np
import pytest
import trimesh
from PIL import Image
from solid_models import l_prism

from torchtrack.errors import ModelError
from torchtrack.object_model.report import describe_model, likely_unit


@pytest.fixture
def prism_path(tmp_path):
    mesh = l_prism()
    mesh.apply_scale(1000)
    mesh.export(tmp_path / "prism.ply")
    return tmp_path / "prism.ply"


def test_the_likeliest_unit_is_one_of_a_usual_size():
    assert likely_unit(0.2) == "m"
    assert likely_unit(200.0) == "mm"
    assert likely_unit(1e9) == "m"


def test_a_mesh_in_millimetres(prism_path):
    report = describe_model(prism_path)
    assert (report.unit, report.is_assumed) == ("mm", True)
    assert report.units == ("cm", "mm", "inch")
    assert report.size == pytest.approx([120, 120, 60])
    assert report.middle == pytest.approx([20, 20, 0])
    assert report.off_centre == pytest.approx(np.hypot(20, 20) / np.linalg.norm([120, 120, 60]))
    assert report.model.diameter_m == pytest.approx(0.18, abs=1e-3)
    assert report.surface is not None
    assert (report.surface.parts, report.surface.faces, report.surface.vertices, report.surface.open_edges) == (1, 20, 12, 0)
    assert (report.surface.contrary_edges, report.surface.flipped_faces, report.surface.dropped_faces) == (0, 0, 0)
    # Six edges of each end, and six along it; the others lie in a plane.
    assert (report.creases, report.silhouettes) == (18, 0)
    assert np.abs(report.planes[0]).tolist() == [0, 0, 1]
    assert (report.revolution, report.turning, report.notes) == (None, None, ())


def test_a_unit_that_is_given_is_kept_and_scale_counts(prism_path):
    report = describe_model(prism_path, "cm", 0.1, centre=True)
    assert (report.unit, report.is_assumed) == ("cm", False)
    assert report.model.diameter_m == pytest.approx(0.18, abs=1e-3)
    assert report.model.centre.abs().max() < 1e-6


def test_faults_of_a_surface_are_counted_and_noted(tmp_path):
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    faces = np.concatenate([mesh.faces[:-1], [[0, 0, 1]]])
    faces[3] = faces[3][::-1]
    trimesh.Trimesh(mesh.vertices, faces, process=False).export(tmp_path / "open.ply")
    report = describe_model(tmp_path / "open.ply")
    assert report.surface is not None
    assert (report.surface.faces, report.surface.dropped_faces, report.surface.open_edges) == (11, 1, 3)
    assert report.surface.contrary_edges == 3
    assert report.surface.flipped_faces == 1
    assert any("wound against their neighbours" in note for note in report.notes)


def test_a_texture_and_one_that_shows_nothing(tmp_path):
    pixels = (np.indices((64, 64)).sum(0) // 16 % 2 * 200).astype(np.uint8)
    for name, image in (("print", pixels), ("plain", np.full_like(pixels, 90))):
        box = trimesh.creation.box((0.1, 0.1, 0.1))
        uv = box.vertices[:, :2] / 0.1 + 0.5
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(image).convert("RGB"))
        box.visual = trimesh.visual.TextureVisuals(uv, material=material)
        box.export(tmp_path / f"{name}.glb")
    printed, plain = (describe_model(tmp_path / f"{name}.glb") for name in ("print", "plain"))
    assert (printed.unit, printed.is_assumed) == ("m", False)
    assert printed.surface is not None
    assert printed.surface.textures == ((64, 64),)
    assert len(printed.model.texture_points) > 100
    assert len(plain.model.texture_points) == 0
    assert any("gives no edges" in note for note in plain.notes)


def test_a_bottle_turns_unseen(tmp_path):
    trimesh.creation.cylinder(0.04, 0.2, sections=64).export(tmp_path / "bottle.ply")
    report = describe_model(tmp_path / "bottle.ply")
    assert report.revolution is not None
    assert report.revolution.direction_obj.abs().tolist() == pytest.approx([0, 0, 1], abs=1e-3)


def test_lines_state_their_own_unit(tmp_path):
    (tmp_path / "lines.json").write_text(json.dumps({"unit": "mm", "polylines": [[[0, 0, 0], [80, 0, 0], [80, 60, 0]]]}))
    report = describe_model(tmp_path / "lines.json")
    assert (report.unit, report.is_assumed, report.surface) == ("mm", False, None)
    assert report.model.diameter_m == pytest.approx(0.1)
    assert len(report.planes) == 0


def test_what_cannot_be_tracked_is_an_error(tmp_path):
    trimesh.creation.box((1e9, 1e9, 1e9)).export(tmp_path / "huge.ply")
    with pytest.raises(ModelError, match="No known unit makes it plausible"):
        describe_model(tmp_path / "huge.ply")
    (tmp_path / "lines.json").write_text(json.dumps({"polylines": [[[0, 0, 0], [0, 0, 0]]]}))
    with pytest.raises(ModelError, match="has no line segments"):
        describe_model(tmp_path / "lines.json")
