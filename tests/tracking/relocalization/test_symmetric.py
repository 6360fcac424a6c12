"""Where else an object may be: in the pose with the same outline, and as it was last seen well."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors, random_pose
from lost_objects import drifting_soon
from states import changed
from tracked_boxes import WINDOW_US, follow, in_motion, moving_box, windows

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import CornerConfig, TrackerConfig
from torchtrack.core.camera import project
from torchtrack.core.lie import difference_about, retract_about, rotation_angle_deg, transform_points
from torchtrack.object_model.symmetry import symmetry_planes
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization import acceptance
from torchtrack.tracking.relocalization.last_seen import where_last_seen
from torchtrack.tracking.relocalization.symmetric import SymmetryPlanes, mirrored
from torchtrack.tracking.validation.status import Status

MIDDLE = torch.tensor([0.01, -0.02, 0.005], dtype=torch.float64)
ACROSS = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64), dim=0)


def predicted(T_cam_obj=None, seed=0):
    """A prediction of one box, at some pose, turning and moving."""
    _, prediction, *_ = in_motion(dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn((12, 12), generator=generator, dtype=torch.float64)
    velocity = torch.randn((1, 6), generator=generator, dtype=torch.float64)
    T_cam_obj = random_pose(1, seed=seed) if T_cam_obj is None else T_cam_obj
    return replace(prediction, T_cam_obj=T_cam_obj, velocity=velocity, covariance=(root @ root.T)[None])


def symmetric_points(count=50):
    """Points in pairs, mirrored in the plane."""
    points = torch.randn((count, 3), generator=torch.Generator().manual_seed(4), dtype=torch.float64) * 0.03
    other = points - 2 * ((points - MIDDLE) @ ACROSS)[:, None] * ACROSS
    return points, other


@pytest.mark.parametrize("seed", range(4))
def test_seen_from_afar_the_mirrored_pose_looks_the_same(seed):
    T_cam_obj = random_pose(1, seed=seed)
    T_cam_obj[:, :3, 3] *= 1000
    prediction = predicted(T_cam_obj, seed)
    other = mirrored(prediction, MIDDLE, ACROSS)
    points, images = symmetric_points()
    far_camera = torch.tensor([[250_000.0, 250_000.0, 99.5, 74.5]], dtype=torch.float64)
    seen, seen_mirrored = (project(transform_points(T, p[None]), far_camera) for T, p in ((T_cam_obj, points), (other.T_cam_obj, images)))
    # Over some 60 pixels.
    assert float((seen - seen_mirrored).abs().max()) < 0.05
    rotation = other.T_cam_obj[0, :3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(rotation)) == pytest.approx(1)
    assert float(rotation_angle_deg(rotation[None], T_cam_obj[:, :3, :3])) > 1


def test_mirrored_twice_it_is_as_it_was():
    prediction = predicted()
    twice = mirrored(mirrored(prediction, MIDDLE, ACROSS), MIDDLE, ACROSS)
    for name in ("T_cam_obj", "velocity", "covariance"):
        torch.testing.assert_close(getattr(twice, name), getattr(prediction, name))


def test_the_mirrored_pose_turns_so_that_it_stays_mirrored():
    """A millisecond later, the mirror image of the pose is where the mirrored pose has gone to; and what it is off by is mirrored alike."""
    prediction = predicted()
    # About a centre in the plane, whose ray the object does not leave.
    objects = replace(prediction.objects, centre_obj=MIDDLE[None])
    prediction = replace(prediction, objects=objects, velocity=prediction.velocity * torch.tensor([1.0, 1, 1, 0, 0, 0]))
    other = mirrored(prediction, MIDDLE, ACROSS)
    later, other_later = (replace(p, T_cam_obj=retract_about(p.T_cam_obj, 1e-3 * p.velocity, MIDDLE[None])) for p in (prediction, other))
    torch.testing.assert_close(mirrored(later, MIDDLE, ACROSS).T_cam_obj, other_later.T_cam_obj, rtol=0, atol=1e-5)
    for axis in range(3):
        step = torch.zeros(1, 6, dtype=torch.float64)
        step[0, axis] = 1e-4
        moved = mirrored(replace(prediction, T_cam_obj=retract_about(prediction.T_cam_obj, step, MIDDLE[None])), MIDDLE, ACROSS)
        change = difference_about(other.T_cam_obj, moved.T_cam_obj, MIDDLE[None])[0, :3]
        narrow = torch.zeros(1, 12, 12, dtype=torch.float64)
        narrow[0, axis, axis] = 1.0
        covariance = mirrored(replace(prediction, covariance=narrow), MIDDLE, ACROSS).covariance[0, :3, :3]
        torch.testing.assert_close(1e8 * change[:, None] * change, covariance, rtol=0, atol=1e-4)


def test_as_last_seen_it_is_turned_and_as_far_away_as_then_in_the_place_of_now():
    prediction, then = predicted(seed=1), random_pose(seed=2)
    other = where_last_seen(prediction, then)
    torch.testing.assert_close(other.T_cam_obj[0, :3, :3], then[:3, :3])
    centre_then = then[:3, :3] @ prediction.objects.centre_obj[0] + then[:3, 3]
    assert float(other.centre_cam[0, 2]) == pytest.approx(float(centre_then[2]))
    torch.testing.assert_close(*(p.centre_cam[0, :2] / p.centre_cam[0, 2] for p in (other, prediction)))
    assert torch.equal(other.covariance, prediction.covariance) and torch.equal(other.velocity, prediction.velocity)


def test_one_prediction_takes_the_place_of_another_where_it_is_taken():
    own, other = predicted(seed=1), mirrored(predicted(seed=1), MIDDLE, ACROSS)
    three = own.copies(0, 3)
    for taken in (True, False):
        now = three.exchanged(1, other, torch.tensor(taken))
        expected = [own, other if taken else own, own]
        for name in ("T_cam_obj", "velocity", "covariance"):
            assert torch.equal(getattr(now, name), torch.cat([getattr(p, name) for p in expected])), name


def test_an_object_is_mirrored_in_its_own_planes_alone():
    prediction = predicted()
    normals = torch.nn.functional.normalize(torch.rand((2, 3, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=-1)
    planes = SymmetryPlanes(MIDDLE.expand(2, 3), normals, (2, 0))
    for plane in range(2):
        expected = mirrored(prediction, MIDDLE, normals[0, plane]).T_cam_obj
        assert torch.equal(planes.mirrored(0, plane, prediction).T_cam_obj, expected)
    assert planes.mirrored(0, 2, prediction) is None
    assert planes.mirrored(1, 0, prediction) is None


# ---- in the tracker


@pytest.mark.parametrize(("changes", "count"), [({}, 3), ({"relocalization": {"mirrored_below": 0}}, 0), ({"relocalization": {"hypotheses": 0}}, 0)])
def test_planes_are_looked_for_only_where_mirrored_poses_are_tried(changes, count):
    tracker = Tracker([box_model()], SMALL_CAMERA, TrackerConfig.model_validate(changes))
    assert tracker.ambiguities.planes.counts == (count,)
    assert bool(tracker.has_symmetry) == (count > 0)


def runs_on(config, change, count=8):
    """Results of a box in full motion whose state was changed, and its true poses; windows end when it is time to look far away."""
    tracker = Tracker([box_model()], SMALL_CAMERA, config)
    trajectory, events = moving_box(pose(), count + 5)
    state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(events, 5))
    state = change(tracker, changed(state, reference_explained_ratio=state.health.mean_score))
    _, results = follow(tracker, state, windows(events, count, 5 * WINDOW_US))
    return results, trajectory


def mirrored_state(tracker, state):
    """The state of a box that follows the mirror image of its pose."""
    prediction = Prediction(tracker.objects, state.T_cam_obj.float(), torch.ones(1, dtype=torch.bool), state.velocity, state.motion.covariance)
    point, normals = symmetry_planes(box_model())
    other = mirrored(prediction, point.float(), normals[0].float())
    assert float(rotation_angle_deg(other.T_cam_obj[:, :3, :3].double(), state.T_cam_obj[:, :3, :3])) > 20
    return changed(state, T_cam_obj=other.T_cam_obj.double(), velocity=other.velocity, covariance=other.covariance)


@pytest.mark.parametrize("mirrored_below", [0.0, 0.8])
def test_a_box_that_followed_its_mirror_image_is_found(monkeypatch, mirrored_below):
    drifting_soon(monkeypatch)
    monkeypatch.setattr(acceptance, "_DRIFT_MIN_RATIO", 1)
    search, disabled = RelocalizationConfig(mirrored_below=mirrored_below), {Component.SCORE_DROP, Component.LAST_SEEN, Component.LOW_SCORE}
    config = TrackerConfig(corners=CornerConfig(max_corners=32), relocalization=search, disabled=disabled)
    results, trajectory = runs_on(config, mirrored_state)
    degrees, millimetres = pose_errors(results[-1].T_cam_obj, trajectory.at(results[-1].t_us))
    if mirrored_below:
        assert float(degrees) < 1 and float(millimetres) < 2
        assert int(results[-1].status) == Status.TRACKING
    else:
        assert float(degrees) > 5


@pytest.mark.parametrize("as_last_seen", [False, True])
def test_a_box_that_ran_off_far_is_found_as_it_was_last_seen(monkeypatch, as_last_seen):
    """Turned off by nearly a right angle and far away: much farther than it is looked for from there."""
    drifting_soon(monkeypatch)

    def run_off(tracker, state):
        away = torch.tensor([[1.3, 0.0, 0.0, 0.0, 0.0, 0.15]], dtype=torch.float64)
        T_cam_obj = retract_about(state.T_cam_obj, away, tracker.centre_obj.double())
        return changed(
            state,
            T_cam_obj=T_cam_obj,
            drift_s=torch.full((1,), 0.1),
            time_since_validated_s=torch.full((1,), 0.2),
            velocity=torch.zeros_like(state.velocity),
        )

    search, disabled = RelocalizationConfig(mirrored_below=0, not_validated_us=0), frozenset() if as_last_seen else {Component.LAST_SEEN}
    config = TrackerConfig(corners=CornerConfig(max_corners=32), relocalization=search, disabled=disabled)
    results, trajectory = runs_on(config, run_off)
    degrees, _ = pose_errors(results[-1].T_cam_obj, trajectory.at(results[-1].t_us))
    assert (float(degrees) < 1) == as_last_seen


def test_where_an_object_was_last_seen_well_is_remembered_and_not_where_it_was_not():
    tracker, trajectory, events = Tracker([box_model()], SMALL_CAMERA), *moving_box(pose(), 8)
    state = tracker.init(pose()[None], 0)
    assert torch.equal(state.health.T_last_validated, state.T_cam_obj)
    state, results = follow(tracker, state, windows(events, 8))
    assert int(results[-1].status) == Status.TRACKING
    assert torch.equal(state.health.T_last_validated, state.T_cam_obj)
    later, results = follow(tracker, state, windows(events[:0], 2, 8 * WINDOW_US))
    assert int(results[-1].status) == Status.TOO_FEW_EVENTS
    assert float(state.health.time_since_validated_s) == 0 and float(later.health.time_since_validated_s) == pytest.approx(0.01)
    assert torch.equal(later.health.T_last_validated, state.health.T_last_validated) and not torch.equal(later.T_cam_obj, state.T_cam_obj)
    assert trajectory.at(state.t_us).shape == state.health.T_last_validated.shape
