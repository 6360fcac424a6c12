"""Hypotheses that are aligned and scored as a batch, and what is exchanged where the best is accepted."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, pose_errors
from lost_objects import lost_object, searched
from tracked_boxes import in_motion, tensors_of

from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.validation.scored_fit import explained_at_rest

SEARCHED = TrackerConfig()
UNSEARCHED = TrackerConfig(relocalization=RelocalizationConfig(hypotheses=0))
IMAGE_SIZE = (SMALL_CAMERA.height, SMALL_CAMERA.width)
# Ten degrees and some millimetres: edges are several pixels off, farther than the tight gate reaches.
DISPLACED = torch.tensor([[0.09, -0.06, 0.12, 0.008, -0.006, 0.0]], dtype=torch.float64)


def test_rest_explains_nothing_of_what_was_looked_for_in_many_places():
    assert explained_at_rest(torch.tensor([1.0, 1.5, 2.0, 3.2])).tolist() == [1.0, 0.5, 0.0, 0.0]


# ---- what is reached


def test_a_displaced_box_is_found_again_by_the_search(dtype):
    tracker, prediction, seen, scored, T_true = in_motion(displaced=DISPLACED, dtype=dtype)
    sigma = torch.tensor([0.1] * 3 + [0.01] * 3 + [1.0] * 3 + [0.1] * 3, dtype=torch.float64)
    prediction = replace(prediction, covariance=torch.diag_embed(sigma.square())[None])
    before, better = scored, searched(lost_object(tracker, prediction, seen, scored, 8.0))
    degrees, millimetres = pose_errors(better.fit.solution.T_cam_obj.double(), T_true)
    assert float(pose_errors(before.fit.solution.T_cam_obj.double(), T_true)[0]) > 3
    assert float(degrees) < 1.0
    assert float(millimetres) < 3.0
    assert float(better.explained_ratio) > float(before.explained_ratio) + tracker.config.relocalization.accept_margin
    assert better.fit.contours.pixels.shape[1] >= before.fit.contours.pixels.shape[1]


FAR = torch.tensor([[0.3, -0.25, 0.2, 0.04, -0.03, 0.02]], dtype=torch.float64)


@pytest.mark.parametrize("velocity_known", [True, False])
def test_a_box_is_found_again_where_hardly_anything_is_known_of_it(velocity_known):
    """Twenty-five degrees and five centimetres off; a velocity that is taken for zero makes no pose explain anything by resting."""
    tracker, prediction, seen, scored, T_true = in_motion(displaced=FAR)
    sigma = torch.tensor([0.3] * 3 + [0.04] * 3 + [2.0] * 3 + [0.3] * 3, dtype=torch.float64)
    velocity = prediction.velocity if velocity_known else torch.zeros_like(prediction.velocity)
    prediction = replace(prediction, covariance=torch.diag_embed(sigma.square())[None], velocity=velocity)
    better = searched(lost_object(tracker, prediction, seen, replace(scored, measured_ratio=torch.zeros(1)), 30.0))
    degrees, millimetres = pose_errors(better.fit.solution.T_cam_obj.double(), T_true)
    assert float(degrees) < 2.0
    assert float(millimetres) < 5.0


@pytest.mark.parametrize("axis", [(0.5, -0.8, 0.3), (-0.6, 0.2, 0.8), (0.9, 0.4, 0.1), (-0.1, -0.7, -0.7)])
def test_a_box_is_found_again_half_a_quarter_turn_off_about_any_axis(axis):
    turn = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0) * 0.8
    displaced = torch.cat([turn, torch.tensor([0.03, -0.02, 0.03], dtype=torch.float64)])[None]
    tracker, prediction, seen, scored, T_true = in_motion(displaced=displaced)
    sigma = torch.tensor([0.7] * 3 + [0.06, 0.06, 0.05] + [2.0] * 3 + [0.3] * 3, dtype=torch.float64)
    prediction = replace(prediction, covariance=torch.diag_embed(sigma.square())[None])
    better = searched(lost_object(tracker, prediction, seen, scored, 40.0))
    degrees, millimetres = pose_errors(better.fit.solution.T_cam_obj.double(), T_true)
    assert float(degrees) < 1.0 and float(millimetres) < 3.0


def test_a_search_leaves_what_it_was_given_as_it_was():
    tracker, prediction, seen, scored, _ = in_motion(displaced=DISPLACED)
    prediction = replace(prediction, covariance=1e2 * prediction.covariance)
    before = [tensor.clone() for tensor in tensors_of(scored)]
    searched(lost_object(tracker, prediction, seen, scored, 8.0))
    for now, then in zip(tensors_of(scored), before, strict=True):
        torch.testing.assert_close(now, then, rtol=0, atol=0, equal_nan=True)
