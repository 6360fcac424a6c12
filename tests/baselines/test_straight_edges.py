"""Which edges of a model are straight, and which objects have enough of them."""

import numpy as np
import pytest
import torch
import trimesh
from helpers import box_model
from PIL import Image

from torchtrack.baselines.straight_edges import (
    run_lengths,
    straight_edges_only,
    straight_mesh_edges,
    straight_segments,
    straight_share,
    straight_texture,
    too_curved,
)
from torchtrack.object_model import ObjectModel
from torchtrack.sim.meshes import make_mesh

ANGLE = np.linspace(0, 2 * np.pi, 81)


def model_of(mesh):
    return ObjectModel.from_mesh(mesh, name="thing")


def chain(points):
    """Edges from each point to the next."""
    points = np.asarray(points, dtype=np.float64)
    return np.stack([points[:-1], points[1:]], 1)


def test_edges_that_follow_each_other_on_a_line_are_one_run():
    edges = chain([[0, 0, 0], [1, 0, 0], [1.5, 0, 0], [1.5, 2, 0]])
    # The order and the direction of edges do not matter.
    assert run_lengths(edges[[2, 0, 1]][:, ::-1], 3.0) == pytest.approx([2, 1.5, 1.5])


def test_edges_on_one_line_that_do_not_touch_are_two_runs():
    edges = np.concatenate([chain([[0, 0, 0], [1, 0, 0]]), chain([[1.1, 0, 0], [2, 0, 0]])])
    assert run_lengths(edges, 3.0) == pytest.approx([1, 0.9])


def test_a_fine_circle_is_not_one_straight_run():
    fine = np.linspace(0, 2 * np.pi, 721)
    edges = chain(np.stack([np.cos(fine), np.sin(fine), 0 * fine], 1))
    assert run_lengths(edges, 3.0).max() < 0.01


def test_no_edges_have_no_runs():
    assert len(run_lengths(np.zeros((0, 2, 3)), 1.0)) == 0


@pytest.mark.parametrize(
    ("mesh", "low", "high"),
    [
        (trimesh.creation.box((0.1, 0.08, 0.06)), 1, 1),
        (trimesh.creation.box((0.1, 0.08, 0.06)).subdivide().subdivide().subdivide(), 1, 1),
        (trimesh.creation.cylinder(0.05, 0.1, sections=64), 0, 0),
        (trimesh.creation.icosphere(subdivisions=3, radius=0.05), 0, 0),
        (trimesh.creation.cylinder(0.05, 0.1, sections=5), 1, 1),
        (trimesh.util.concatenate([trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.icosphere(subdivisions=3, radius=0.1)]), 0.2, 0.8),
    ],
    ids=["box", "fine_box", "cylinder", "sphere", "prism", "box_and_sphere"],
)
def test_share_of_the_contour_on_straight_edges(mesh, low, high):
    assert low - 1e-6 <= straight_share(model_of(mesh)) <= high + 1e-6


def test_a_curved_object_says_how_curved_it_is():
    assert too_curved(box_model()) is None
    reason = too_curved(model_of(trimesh.creation.icosphere(subdivisions=3, radius=0.05)))
    assert reason == "'thing' is curved: 0 % of its contour is on straight edges, 50 % are needed"


@pytest.mark.parametrize(("shape", "straight"), [("wedge", True), ("satellite", True), ("planar", True), ("mug", False), ("robot", False)])
def test_simulated_objects_are_of_the_kind_that_they_stand_for(shape, straight):
    assert (too_curved(model_of(make_mesh(shape))) is None) == straight


def test_polylines_are_straight_or_not():
    circle = ObjectModel.from_polylines([np.stack([0.05 * np.cos(ANGLE), 0.05 * np.sin(ANGLE), 0 * ANGLE], 1)])
    square = ObjectModel.from_polylines([[[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0, 0, 0]]])
    assert (straight_share(circle), straight_share(square)) == (0, 1)
    assert not straight_segments(circle).any() and straight_segments(square).all()


def printed_card(size=512):
    """A card with a square and a disc of the same size beside it."""
    image = np.full((size, 2 * size, 3), 255, np.uint8)
    v, u = np.mgrid[:size, : 2 * size]
    image[(np.abs(u - size / 2) < size / 4) & (np.abs(v - size / 2) < size / 4)] = 0
    image[(u - 1.5 * size) ** 2 + (v - size / 2) ** 2 < (size / 4) ** 2] = 0
    vertices = np.array([[0, 0, 0], [0.2, 0, 0], [0.2, 0.1, 0], [0, 0.1, 0]])
    card = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], process=False)
    card.visual = trimesh.visual.TextureVisuals(uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float), image=Image.fromarray(image))
    return model_of(card)


def test_texture_on_lines_is_straight_and_on_circles_is_not():
    model = printed_card()
    straight = straight_texture(model)
    on_square = model.texture_points[:, 0].numpy() < 0.1
    assert on_square.sum() > 50 and (~on_square).sum() > 50
    assert straight[on_square].mean() > 0.85
    assert not straight[~on_square].any()


def test_what_is_left_is_straight_and_still_hides():
    can = trimesh.creation.cylinder(0.03, 0.1, sections=64)
    model = model_of(trimesh.util.concatenate([trimesh.creation.box((0.1, 0.1, 0.1)), can.apply_translation([0.2, 0, 0])]))
    lines = straight_edges_only(model)
    assert len(lines.edge_points) == straight_mesh_edges(model).sum() == 12
    assert torch.equal(lines.triangles, model.triangles)
    assert (lines.diameter_m, len(lines.texture_points)) == (model.diameter_m, 0)
