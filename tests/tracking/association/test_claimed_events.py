"""What objects explain that are seen well is no evidence for others."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose
from lost_states import uncertain
from predicted_boxes import CONTOURS, boxes
from states import changed
from tracked_boxes import WIDE_CAMERA, assert_same, follow, merged, moving_box, scene_of_one_stream, windows

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.association.claimed_events import CLAIMED_WITHIN_PX, claimed_pixels, without_claimed
from torchtrack.tracking.frontend.window_events import WindowEvents
from torchtrack.tracking.validation.status import Status

WINDOW_S = 0.02


def claimed_by(speed_m_s=0.0, is_seen_well=(True, True), dtype=torch.float64):
    """Pixels that two boxes claim, each in a stream of its own, the contours of these, and their prediction."""
    velocity = torch.tensor([[0.0, 0.0, 0.0, speed_m_s, 0.0, 0.0]] * 2)
    prediction = boxes(torch.stack([pose(), pose((0.4, -0.7, 0.3))]), velocity=velocity, dtype=dtype)
    contours = prediction.objects.contours(prediction.T_cam_obj, CONTOURS)
    window_s = torch.full((2,), WINDOW_S, dtype=dtype)
    return claimed_pixels(prediction, contours, torch.tensor(is_seen_well), window_s), contours, prediction


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pixels_near_a_contour_are_claimed_and_no_others(dtype):
    claimed, contours, _ = claimed_by(dtype=dtype)
    height, width = SMALL_CAMERA.height, SMALL_CAMERA.width
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    for number in range(2):
        points = contours.pixels[number, contours.mask[number]].round()
        away = (torch.stack([u, v], -1).view(-1, 1, 2) - points).abs().amax(-1).amin(-1).view(height, width)
        assert torch.equal(claimed[number], away <= CLAIMED_WITHIN_PX)


def test_a_contour_claims_its_way_through_the_window():
    at_rest, contours, prediction = claimed_by()
    moving, _, _ = claimed_by(speed_m_s=0.4)
    way_px = int(0.4 * WINDOW_S * float(prediction.objects.px_per_m(prediction.T_cam_obj)[0]))
    assert way_px >= 2 * CLAIMED_WITHIN_PX
    # It came from the left.
    left = int(contours.pixels[0, contours.mask[0], 0].min())
    assert not at_rest[0, :, left - way_px].any()
    assert moving[0, :, left - way_px : left].any(0).all()


def test_what_is_not_seen_well_claims_nothing():
    claimed, _, _ = claimed_by(is_seen_well=(False, True))
    assert not claimed[0].any()
    assert claimed[1].any()


def test_only_those_concerned_go_without():
    claimed = torch.zeros(1, 20, 30, dtype=torch.bool)
    claimed[0, 4:8, 10:20] = True
    pixels = torch.tensor([[12.4, 5.0], [9.0, 5.0], [torch.nan, 5.0], [-3.0, 5.0], [12.0, 400.0]])
    nothing = torch.zeros(2, 5)
    events = WindowEvents(pixels.expand(2, 5, 2), nothing, nothing, torch.ones(2, 5, dtype=torch.bool))
    left = without_claimed(events, claimed, torch.zeros(2, dtype=torch.int64), torch.tensor([True, False]))
    assert left.mask.tolist() == [[False, True, True, True, True], [True] * 5]


# ---- in the tracker


def beside_a_lost_one(config=None, kernels=True):
    """A box that is seen well, and one that lies right beside it, of which there is no event: both, after so long that it is lost."""
    starts, _, _, _ = scene_of_one_stream(0)
    near = starts[0].clone()
    near[0, 3] += 0.12
    _, events = moving_box(starts[0], 20, WIDE_CAMERA)
    tracker = Tracker([box_model()] * 2, WIDE_CAMERA, config, kernels=kernels)
    state = tracker.init(torch.stack([starts[0], near]), 0)
    state, _ = follow(tracker, state, windows(events, 5))
    seen_once = torch.tensor([0.0, 0.1], dtype=torch.float64).to(state.health.time_since_validated_s)
    covariance = torch.where(torch.tensor([False, True])[:, None, None], uncertain(state, 0.1), state.motion.covariance)
    state = changed(state, time_since_validated_s=seen_once, mean_score=torch.ones_like(state.health.mean_score), covariance=covariance)
    return follow(tracker, state, windows(events, 20)[5:])


@pytest.mark.parametrize("kernels", [True, False])
def test_a_lost_object_is_not_found_on_the_edges_of_another(kernels):
    _, results = beside_a_lost_one(kernels=kernels)
    assert all(int(result.status[0]) == Status.TRACKING for result in results)
    assert all(int(result.status[1]) >= Status.LOST for result in results)


def test_without_that_part_it_is():
    _, results = beside_a_lost_one(TrackerConfig(disabled={Component.OTHERS_EVENTS}))
    assert any(int(result.status[1]) < Status.LOST for result in results)


def test_what_is_seen_well_keeps_the_edges_that_it_shares():
    """Two boxes in one place explain the same events, and both are tracked."""
    _, events = moving_box(pose(), 8)
    tracker = Tracker([box_model()] * 2, SMALL_CAMERA)
    alone = Tracker([box_model()] * 2, SMALL_CAMERA, TrackerConfig(disabled={Component.OTHERS_EVENTS}))
    results = [follow(each, each.init(torch.stack([pose(), pose()]), 0), windows(events, 8))[1] for each in (tracker, alone)]
    for with_it, without in zip(*results, strict=True):
        assert_same(with_it, without)


def test_streams_do_not_matter_to_one_another():
    """What a box explains in one stream is evidence in another."""
    _, events = moving_box(pose(), 8)
    tracker = Tracker([box_model()] * 2, [SMALL_CAMERA] * 2, stream_index=[0, 1])
    twice = [(merged(part, replace(part, stream_index=part.stream_index + 1)), end_us) for part, end_us in windows(events, 8)]
    twice = [(part[part.stream_index.sort(stable=True).indices], end_us) for part, end_us in twice]
    state, _ = follow(tracker, tracker.init(torch.stack([pose(), pose()]), 0), twice[:5])
    unseen_s = torch.tensor([0.0, 0.1]).to(state.health.time_since_validated_s)
    _, results = follow(tracker, changed(state, time_since_validated_s=unseen_s), twice[5:])
    assert all((result.status == int(Status.TRACKING)).all() for result in results)
