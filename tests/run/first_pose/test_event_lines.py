"""Events as lines: how they moved, and how near they are along each direction."""

import pytest
import torch

from torchtrack.core.camera import Camera, project
from torchtrack.core.lie import se3_exp, transform_points
from torchtrack.run.first_pose.event_lines import DIRECTIONS, EventLines, direction_of, near_events, sharpest_velocity
from torchtrack.run.first_pose.rotations import all_rotations, rotations_around
from torchtrack.run.first_pose.search_view import BOX_PX, SIDE_PX, SearchView
from torchtrack.run.first_pose.start import Box

SIDE = 96
BOX = Box(20.0, 20.0, 76.0, 76.0)


def moving_square(velocity_px, count=6000):
    """Events of the outline of a square that moves, and when they came."""
    rng = torch.Generator().manual_seed(0)
    along = torch.rand(count, generator=rng) * 40 - 20
    end = torch.randint(2, (count,), generator=rng).float() * 40 - 20
    places = torch.where((torch.arange(count) % 2 == 0)[:, None], torch.stack([along, end], 1), torch.stack([end, along], 1)) + 48
    fraction = torch.rand(count, generator=rng).sort().values
    return (places + torch.tensor(velocity_px) * fraction[:, None]).round(), fraction


@pytest.mark.parametrize("velocity_px", [(0.0, 0.0), (7.0, -4.0), (-15.0, 11.0)])
def test_the_sharpest_velocity_is_that_of_the_object(velocity_px):
    pixels, fraction = moving_square(velocity_px)
    assert torch.allclose(sharpest_velocity(pixels, fraction, SIDE), torch.tensor(velocity_px), atol=0.8)


def test_events_are_near_along_their_own_line():
    lines = EventLines.from_events(*moving_square((6.0, 5.0)), BOX, SIDE)
    upright, level = direction_of(torch.tensor([[1.0, 0.0], [0.0, 1.0]]))
    on_left = torch.tensor([[28.0, 48.0]])
    assert near_events(lines.coarse, on_left, upright[None]) > 0.8
    assert near_events(lines.coarse, on_left, level[None]) < near_events(lines.coarse, on_left, upright[None]) - 0.3
    assert near_events(lines.fine, torch.tensor([[48.0, 48.0], [-5.0, 48.0]]), torch.tensor([0, 0])).tolist() == [0, 0]
    assert float(lines.weights.sum()) == pytest.approx(1)


def test_directions_are_of_lines():
    normals = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    assert direction_of(normals).tolist() == [0, 0, DIRECTIONS // 2, DIRECTIONS // 2]


def test_a_view_shows_what_the_camera_sees():
    camera = Camera(fx=300.0, fy=320.0, cx=310.0, cy=250.0, width=640, height=480)
    view = SearchView.of_box(camera, Box(400.0, 60.0, 520.0, 200.0))
    T_cam_obj = se3_exp(torch.tensor([[0.3, 0.2, 0.1, 0.25, -0.2, 0.6]], dtype=torch.float64))
    points = torch.rand(1, 20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.05
    seen = project(transform_points(T_cam_obj, points), camera.intrinsics(torch.float64)[None])[0]
    in_view = project(transform_points(view.from_camera(T_cam_obj), points), view.camera.intrinsics(torch.float64)[None])[0]
    assert torch.allclose(view.pixels(seen).double(), in_view, atol=1e-3)
    assert torch.allclose(view.to_camera(view.from_camera(T_cam_obj)), T_cam_obj)
    assert torch.allclose(view.box.centre, torch.full((2,), (SIDE_PX - 1) / 2), atol=5)
    assert float(view.box.size.max()) == pytest.approx(BOX_PX, rel=0.15)


def test_rotations_are_spread_evenly():
    rotations = all_rotations()
    wanted = rotations_around(torch.eye(3), 30.0, 15.0)
    cosines = (torch.einsum("nij,mij->nm", wanted, rotations) - 1) / 2
    assert float(torch.rad2deg(cosines.clamp(-1, 1).acos()).amin(1).max()) < 10
    assert bool((wanted - torch.eye(3, dtype=torch.float64)).abs().amax((1, 2)).eq(0).any())


def test_a_box_grows_and_holds():
    box = Box(10.0, 20.0, 30.0, 60.0)
    assert box.grown(0.5) == Box(0.0, 0.0, 40.0, 80.0) and box.centre.tolist() == [20, 40] and box.size.tolist() == [20, 40]
    assert box.holds(torch.tensor([[10.0, 20.0], [9.0, 20.0], [30.0, 61.0]])).tolist() == [True, False, False]
