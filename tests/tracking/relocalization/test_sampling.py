"""Poses worth aligning: how they are drawn, how events score them, and that the true pose is among them."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, generator, pose, pose_errors
from tracked_boxes import in_motion

from torchtrack import Tracker
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import backend_is_installed
from torchtrack.tracking.relocalization.event_image import event_density
from torchtrack.tracking.relocalization.sampling import draw_offsets, rehearse, sample_anywhere, sample_near, score_outlines
from torchtrack.tracking.relocalization.view_sphere import outlines_at, thinned

IMAGE_SIZE = (SMALL_CAMERA.height, SMALL_CAMERA.width)


def random_covariance(seed=0, scale=1e-4):
    root = torch.randn((1, 12, 24), generator=generator(seed), dtype=torch.float64)
    return scale * root @ root.mT / 24


# ---- what is drawn


def test_offsets_are_drawn_with_the_covariance():
    covariance = random_covariance()
    offsets = draw_offsets(covariance, 8000)
    assert offsets.shape == (8000, 12)
    assert (offsets[0] == 0).all()
    sampled = offsets[:, :6].T @ offsets[:, :6] / len(offsets)
    scale = covariance[0, :6, :6].diagonal().sqrt()
    assert float(((sampled - covariance[0, :6, :6]) / (scale[:, None] * scale)).abs().max()) < 0.03
    assert float((offsets[:, :6].mean(0) / scale).abs().max()) < 0.01
    assert torch.isfinite(offsets).all()


def test_the_velocity_of_an_offset_is_what_its_pose_implies():
    """The mean of the velocity given the pose; with a covariance that knows of no relation there is none."""
    covariance = random_covariance()
    offsets = draw_offsets(covariance, 100)
    gain = covariance[0, 6:, :6] @ torch.linalg.inv(covariance[0, :6, :6])
    torch.testing.assert_close(offsets[:, 6:], offsets[:, :6] @ gain.T)
    unrelated = covariance.clone()
    unrelated[:, 6:, :6] = unrelated[:, :6, 6:] = 0
    assert float(draw_offsets(unrelated, 100)[:, 6:].abs().max()) == 0


def test_the_draw_is_the_same_every_time_and_more_of_it_begins_as_less():
    covariance = random_covariance()
    assert torch.equal(draw_offsets(covariance, 300), draw_offsets(covariance, 300))
    assert torch.equal(draw_offsets(covariance, 600)[:300], draw_offsets(covariance, 300))


# ---- how poses are scored


def test_density_counts_the_events_around_every_pixel():
    places = torch.tensor([[[10.0, 20.0], [10.4, 20.4], [11.0, 20.0], [60.0, 30.0], [0.0, 0.0], [90.0, 40.0]]])
    density = event_density(places, torch.tensor([[True] * 5 + [False]]), IMAGE_SIZE)
    # Two pixels of border all around.
    assert density.shape == (1, 154, 204)
    for (u, v), count in {(10, 20): 3, (9, 20): 2, (12, 21): 1, (60, 30): 1, (62, 30): 0, (0, 0): 1, (90, 40): 0}.items():
        assert int(density[0, v + 2, u + 2]) == count
    assert int(density.sum()) == 9 * 5


def test_events_outside_the_image_or_nowhere_are_not_counted():
    places = torch.tensor([[[-50.0, 3.0], [1e9, 1e9], [torch.nan, 5.0], [50.0, torch.inf], [199.0, 149.0]]])
    density = event_density(places, torch.ones(1, 5, dtype=torch.bool), IMAGE_SIZE)
    assert int(density.sum()) == 9
    assert int(density[0, 151, 201]) == 1


def scores_at(prediction, outlines, offsets, image):
    return score_outlines(outlines, prediction.poses_at(offsets[:, :6]), prediction.objects.intrinsics, image)


def test_the_true_pose_is_scored_best(dtype):
    _, prediction, seen, scored, _ = in_motion(dtype=dtype)
    density = event_density(seen.pixels + prediction.plane_velocity(seen.pixels) * seen.age_s[..., None], seen.mask, IMAGE_SIZE)
    away = torch.zeros(13, 12, dtype=dtype)
    for axis in range(6):
        away[2 * axis + 1, axis], away[2 * axis + 2, axis] = (0.15, -0.15) if axis < 3 else (0.015, -0.015)
    # Depth moves contours least.
    away[11:] *= 4
    scores = scores_at(prediction, thinned(scored.fit.contours), away, density.clamp(max=3))
    assert int(scores.argmax()) == 0
    assert float(scores[0]) > 1.5 * float(scores[1:].max())


def test_scores_of_poses_behind_the_camera_are_numbers():
    _, prediction, seen, scored, _ = in_motion()
    offsets = torch.zeros(2, 12)
    offsets[1, 5] = -2.0
    density = event_density(seen.pixels, seen.mask, IMAGE_SIZE)
    for outlines in (thinned(scored.fit.contours), outlines_at(prediction, prediction.poses_at(offsets[:, :6]), TrackerConfig())):
        assert torch.isfinite(scores_at(prediction, outlines, offsets, density)).all()


# ---- what is sampled


def nearest(offsets, prediction, T_true):
    """The smallest error of poses at some offsets, one degree being as bad as a millimetre."""
    return float(sum(pose_errors(prediction.poses_at(offsets[:, :6]).double(), T_true.expand(len(offsets), 4, 4))).min())


def places_of(prediction, seen):
    """Where events are at the window's end, and which of them exist."""
    return prediction.carried(seen.pixels, seen.age_s), seen.mask


def uncertain():
    """The prediction of a box that may be anywhere, and its events."""
    _, prediction, seen, _, _ = in_motion()
    return replace(prediction, covariance=1e-2 * torch.eye(12, dtype=torch.float64)[None]), seen


@pytest.mark.parametrize("rotation_rad", [0.15, 0.3, 0.45])
def test_a_pose_near_the_true_one_is_among_the_sample(rotation_rad, dtype):
    displaced = torch.tensor([[rotation_rad, -rotation_rad, rotation_rad, 0.02, -0.02, 0.01]], dtype=torch.float64)
    tracker, prediction, seen, scored, T_true = in_motion(displaced=displaced, dtype=dtype)
    sigma = torch.tensor([rotation_rad] * 3 + [0.03] * 3 + [1.0] * 3 + [0.1] * 3, dtype=torch.float64)
    prediction, places = replace(prediction, covariance=torch.diag(sigma.square())[None]), places_of(prediction, seen)
    shifted = sample_anywhere(prediction, places, tracker.config)
    drawn = sample_near(prediction, scored.fit.contours, places, tracker.config)
    assert shifted.shape == drawn.shape == (24, 12)
    assert shifted.dtype == dtype
    assert not shifted[0].any()
    assert nearest(shifted, prediction, T_true) < min(10, 0.7 * nearest(drawn, prediction, T_true))


def test_as_many_are_sampled_as_are_to_be_tried_or_kept():
    prediction, seen = uncertain()
    for few, count in (
        (RelocalizationConfig(hypotheses=5, rotations=40), 5),
        (RelocalizationConfig(rotations=6), 4),
        (RelocalizationConfig(rotations=1, hypotheses=100), 2),
        (RelocalizationConfig(hypotheses=1), 1),
    ):
        config = TrackerConfig(relocalization=few)
        assert len(sample_anywhere(prediction, places_of(prediction, seen), config)) == count


def test_without_events_what_is_sampled_is_still_finite():
    prediction, seen = uncertain()
    nothing = seen.pixels, torch.zeros_like(seen.mask)
    assert torch.isfinite(sample_anywhere(prediction, nothing, TrackerConfig())).all()


def test_where_the_prediction_is_good_only_what_it_allows_is_sampled():
    tracker, prediction, seen, scored, _ = in_motion()
    prediction = replace(prediction, covariance=1e-6 * torch.eye(12, dtype=torch.float64)[None])
    offsets = sample_near(prediction, scored.fit.contours, (seen.pixels, seen.mask), tracker.config)
    drawn = draw_offsets(prediction.covariance, 2000).float()
    assert ((offsets[:, None] == drawn).all(-1).any(-1)).all()
    assert float(offsets[:, :6].abs().max()) < 5e-3


# ---- before the first window


@pytest.mark.parametrize(("hypotheses", "times"), [(24, 1), (0, 0)])
def test_a_search_is_rehearsed_before_the_first_window(hypotheses, times, monkeypatch):
    rehearsed = []
    monkeypatch.setattr(
        "torchtrack.tracking.tracker.rehearse", lambda prediction, config: (rehearsed.append(prediction), rehearse(prediction, config))
    )
    tracker = Tracker([box_model()], SMALL_CAMERA, TrackerConfig(relocalization=RelocalizationConfig(hypotheses=hypotheses)))
    tracker.prepare(tracker.init(pose()[None], 0))
    assert len(rehearsed) == times * backend_is_installed()
