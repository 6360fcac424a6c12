"""A pose made by hand, without a browser: what each action makes of it, and what is shown of it."""

import numpy as np
import pytest
import torch
from moving_bracket import AT_US, error_deg, write_bracket
from solid_models import l_prism
from tiny_sequence import CAMERA

from torchtrack.config.load import load
from torchtrack.config.run import RunConfig
from torchtrack.core.camera import Camera, distort, project
from torchtrack.core.lie import rotation_angle_deg, so3_exp, transform_points
from torchtrack.object_model import ObjectModel
from torchtrack.run.first_pose.by_hand import (
    Clicked,
    HandPose,
    Moved,
    Order,
    ShownChosen,
    TimeChosen,
    ideal_camera,
    latest,
    placed_before,
)
from torchtrack.run.first_pose.clicks import Ray, clicked_pixel, clicked_point
from torchtrack.run.first_pose.event_view import ContourView, event_image
from torchtrack.run.first_pose.in_browser import last_event_us
from torchtrack.run.first_pose.page import panel_text
from torchtrack.run.first_pose.start import Start
from torchtrack.run.session import open_session

IMAGE_DEPTH_M = 0.9
# On the two ends of the bracket, near its corners.
POINTS = torch.tensor([(x, y, z) for z in (0.03, -0.03) for x, y in ((0.075, -0.035), (-0.035, 0.075), (-0.035, -0.035))], dtype=torch.float64)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    truth = write_bracket(folder)
    session = open_session(load(RunConfig, None, {"source": str(folder / "bracket.npz"), "start_us": AT_US}))
    return session, Start.from_session(session), truth


def intrinsics():
    return CAMERA.intrinsics(torch.float64)


def towards(point_cam):
    """A click on a point of the camera's frame, from where the camera is."""
    return Clicked(Ray(np.zeros(3), np.asarray(point_cam, float)), IMAGE_DEPTH_M)


def towards_pixel(pixel):
    return towards(np.append((np.asarray(pixel) - CAMERA.matrix[:2, 2]) / [CAMERA.fx, CAMERA.fy], 1.0))


def picked(pose, source, truth, points):
    """After clicks on the pixels of some points, and on the points themselves, seen straight from above them."""
    for point in points:
        pixel = project(transform_points(truth, point[None]), intrinsics())[0]
        pose = pose.after(towards_pixel(pixel.numpy()), source)
        above = transform_points(pose.T_cam_obj, torch.stack([point * torch.tensor([1.0, 1.0, 10.0]), point]))
        pose = pose.after(Clicked(Ray(above[0].numpy(), (above[1] - above[0]).numpy()), IMAGE_DEPTH_M), source)
    return pose


def test_pairs_of_picks_give_the_pose_and_refining_keeps_it(scene):
    session, start, truth = scene
    pose = HandPose(start, placed_before(start)).after(Order.PICK, session.events)
    three = picked(pose, session.events, truth, POINTS[:3])
    assert len(three.points) == 3 and torch.equal(three.T_cam_obj, pose.T_cam_obj)
    six = picked(three, session.events, truth, POINTS[3:])
    assert float(rotation_angle_deg(six.T_cam_obj[:3, :3], truth[:3, :3])) < 1 and not six.rough
    refined = six.after(Order.REFINE, session.events)
    assert refined.quality > 0.5 and error_deg(refined.T_cam_obj, truth) < 3
    saved = refined.after(Order.SAVE, session.events)
    assert saved.saved and saved.result.at_us == AT_US and saved.result.quality == refined.quality


def test_a_pose_that_was_dragged_is_refined_from_far(scene):
    session, start, truth = scene
    T = truth.clone()
    T[:3, :3] = so3_exp(torch.deg2rad(torch.tensor([0.0, 30.0, 0.0], dtype=torch.float64))) @ T[:3, :3]
    dragged = HandPose(start, placed_before(start)).after(Moved(T), session.events)
    assert dragged.rough and np.isnan(dragged.quality) and torch.equal(dragged.T_cam_obj, T)
    assert error_deg(dragged.after(Order.REFINE, session.events).T_cam_obj, truth) < 5


def test_a_pick_that_is_undone_leaves_what_was_before(scene):
    session, start, truth = scene
    pose = picked(HandPose(start, truth, picking=True), session.events, truth, POINTS[:5])
    waiting = pose.after(towards_pixel((60, 45)), session.events)
    assert waiting.awaits_point and not pose.awaits_point
    assert waiting.after(Order.UNDO, session.events).pixels == pose.pixels
    fewer = pose.after(Order.UNDO, session.events)
    assert len(fewer.pixels) == len(fewer.points) == 4 and not fewer.rough
    assert HandPose(start, truth).after(Order.UNDO, session.events).pixels == ()


def test_clicks_count_while_picking_alone_and_where_something_is(scene):
    session, start, truth = scene
    dragging = HandPose(start, truth)
    assert dragging.after(towards_pixel((60, 45)), session.events) == dragging
    picking = dragging.after(Order.PICK, session.events)
    assert picking.after(towards_pixel((-20, 45)), session.events).note == "That was beside the image."
    waiting = picking.after(towards_pixel((60, 45)), session.events)
    past = waiting.after(towards_pixel((1, 1)), session.events)
    assert past.note == "That was beside the object." and past.awaits_point
    assert not past.after(Order.DRAG, session.events).picking


def test_picks_that_fit_no_pose_are_told_and_stay(scene):
    session, start, truth = scene
    pose = picked(HandPose(start, truth, picking=True), session.events, truth, POINTS[:5])
    doubtful = pose.after(towards_pixel((5, 85)), session.events).after(towards(truth[:3, 3].numpy()), session.events)
    assert "px off the pose that fits all best" in doubtful.note and len(doubtful.points) == 6
    on_a_line = HandPose(start, truth, picking=True)
    for u in (40, 50, 60, 70):
        on_a_line = on_a_line.after(towards_pixel((u, 45)), session.events).after(towards(truth[:3, 3].numpy()), session.events)
    assert "all points lie on a line" in on_a_line.note and torch.equal(on_a_line.T_cam_obj, truth)


def test_another_time_shows_its_events_and_drops_the_picks(scene):
    session, start, truth = scene
    pose = HandPose(start, truth, picking=True).after(towards_pixel((60, 45)), session.events)
    later = pose.after(TimeChosen(AT_US + 40_000), session.events)
    assert later.start.at_us == AT_US + 40_000 and later.pixels == () and "picks" in later.note
    assert not np.array_equal(event_image(later.start, later.shown_us), event_image(start, pose.shown_us))
    nothing_there = pose.after(TimeChosen(90_000_000), session.events)
    assert "no events within" in nothing_there.note and nothing_there.start is start
    assert pose.after(ShownChosen(3000), session.events).shown_us == 3000


def test_what_cannot_be_done_is_told_and_changes_nothing(scene):
    session, start, truth = scene
    behind = truth.clone()
    behind[2, 3] = -0.5
    pose = HandPose(start, behind)
    assert "behind the camera" in pose.after(Order.REFINE, session.events).note
    refused = pose.after(Order.SAVE, session.events)
    assert not refused.saved and refused.note.startswith("'bracket'")
    assert len(ContourView.of_model(start.model, start.camera).lines(behind)) == 0


def test_of_a_drag_only_the_end_counts(scene):
    T = torch.eye(4, dtype=torch.float64)
    moves = [Moved(T), Moved(2 * T), Moved(3 * T)]
    click = towards((0, 0, 1))
    assert latest([*moves, Order.UNDO, Order.UNDO, click, click, TimeChosen(1), TimeChosen(2)]) == [
        moves[2], Order.UNDO, Order.UNDO, click, click, TimeChosen(2),
    ]  # fmt: skip


def test_the_object_begins_where_the_events_are(scene):
    _, start, truth = scene
    T = placed_before(start)
    centre = start.model.centre.double()
    pixels = [project(transform_points(pose, centre[None]), intrinsics())[0] for pose in (T, truth)]
    assert float((pixels[0] - pixels[1]).norm()) < 10
    assert 0.6 < float(T[2, 3] / truth[2, 3]) < 1.5


def test_contours_lie_on_the_first_events(scene):
    _, start, truth = scene
    lines = ContourView.of_model(start.model, start.camera).lines(truth)
    image = event_image(start, 2000)
    u, v = lines.mean(1).round().astype(int).T
    bright = np.stack([image[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)]).max(0) > 0
    assert len(lines) > 100 and bright.mean() > 0.5
    # The first events are the brightest.
    at_once = event_image(start, 20_000)
    earliest = start.events[:20]
    assert at_once[earliest.y, earliest.x].min() > 240


def test_clicks_on_a_model_of_lines():
    square = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0, 0, 0]], float)
    model = ObjectModel.from_polylines([square])
    point = clicked_point(Ray(np.array([0.05, 0.002, -1.0]), np.array([0.0, 0.0, 2.0])), model)
    assert point == pytest.approx([0.05, 0.0, 0.0])
    assert clicked_point(Ray(np.array([0.05, 0.05, -1.0]), np.array([0.0, 0.0, 1.0])), model) is None


def test_a_click_meets_the_near_side_and_the_pixel_behind_it():
    box = ObjectModel.from_mesh(l_prism())
    assert clicked_point(Ray(np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])), box) == pytest.approx([0, 0, -0.03])
    ray = Ray(np.array([0.3, 0.0, 0.0]), np.array([-0.3, 0.0, 2.0]))
    assert clicked_pixel(ray, CAMERA, 2.0) == pytest.approx([CAMERA.cx, CAMERA.cy])
    assert clicked_pixel(Ray(np.zeros(3), np.array([1.0, 0.0, 0.0])), CAMERA, 2.0) is None
    assert clicked_pixel(Ray(np.zeros(3), np.array([0.0, 0.0, -1.0])), CAMERA, 2.0) is None


def test_picks_are_of_the_image_without_distortion():
    bent = Camera(150.0, 150.0, 59.5, 44.5, 120, 90, "plumb_bob", (-0.3, 0.1, 0.0, 0.0))
    straight = ideal_camera(bent)
    pixel = np.array([[100.0, 70.0]])
    assert np.array_equal(distort(pixel, straight), pixel) and not np.allclose(distort(pixel, bent), pixel)
    assert np.array_equal(straight.matrix, bent.matrix)


def test_times_reach_to_the_last_event(scene):
    session, start, _ = scene
    assert last_event_us(session.events, AT_US, None) == int(start.events.t_us[-1])
    assert last_event_us(session.events, AT_US, AT_US + 10_000) <= AT_US + 10_000


def test_the_panel_says_what_comes_next(scene):
    _, start, truth = scene
    dragging = HandPose(start, truth, quality=0.834, note="so")
    assert "pairs" not in panel_text(dragging, "mug") and "explain 83 %" in panel_text(dragging, "mug") and "*so*" in panel_text(dragging, "mug")
    picking = HandPose(start, truth, picking=True)
    assert "0 pairs" in panel_text(picking, "mug") and "Click on a pixel" in panel_text(picking, "mug")
    assert "Click on the point" in panel_text(HandPose(start, truth, picking=True, pixels=((1.0, 2.0),)), "mug")
