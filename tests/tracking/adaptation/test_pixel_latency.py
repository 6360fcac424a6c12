"""Pixel latency: what of a sensor's events tells it, how that is remembered, and what becomes of late events."""

from dataclasses import replace

import pytest
import torch
from states import changed
from tracked_boxes import in_motion, poses_of, started

from torchtrack.config.tracker import AssociationConfig, TrackerConfig
from torchtrack.tracking.adaptation.pixel_latency import dated, late_share_after, slowness, unknown_latency
from torchtrack.tracking.association.observations import select_events
from torchtrack.tracking.estimation.rounds import gate_scale_of, index_for

# Bursts so long that what moves as the boxes of these tests do comes far enough.
LONG = AssociationConfig(pixel_latency=True, burst_us=30_000)
SEEN = torch.zeros(1)
OFF = [LONG.model_copy(update=change) for change in ({"pixel_latency": False}, {"burst_us": 0}, {"max_events": 0})]


def observed(dtype=torch.float32):
    """Prediction, contours and observations of a box in motion, and their matches."""
    tracker, prediction, seen, actual, _ = in_motion(dtype=dtype)
    contours = prediction.objects.contours(prediction.T_cam_obj, tracker.config.contours)
    index = index_for(contours, tracker.image_size, tracker.config, gate_scale_of(torch.zeros(1, dtype=dtype), tracker.config))
    return prediction, contours, select_events(seen, index, prediction.moving(compensated=True), 1000), actual.fit.matches


def share_after(into_burst_s, before=0.1, config=LONG, *, known=True, dtype=torch.float32, **changes):
    """Share of late events after a window in which all are that far into their bursts."""
    prediction, contours, observations, matches = observed(dtype)
    observations = replace(observations, into_burst_s=torch.full_like(observations.age_s, into_burst_s), **changes)
    before = torch.full((1,), before, dtype=dtype)
    return float(late_share_after(before, observations, contours, matches, prediction, torch.tensor([known]), config))


# ---- what tells it


def test_late_events_make_it_more_and_others_less(dtype):
    late, early = share_after(0.029, dtype=dtype), share_after(0.0, dtype=dtype)
    assert early < 0.1 < late
    # Twenty thousand events are remembered: one window changes little.
    assert late - early < 1000 / 21_000


def test_what_an_object_that_is_not_sure_of_its_pose_sees_does_not_count():
    assert share_after(0.029, known=False) == pytest.approx(0.1)


def test_edges_too_slow_to_come_far_in_a_burst_tell_nothing():
    assert share_after(0.001, config=AssociationConfig(pixel_latency=True, burst_us=1000)) == pytest.approx(0.1)


def test_corners_tell_nothing():
    assert share_after(0.029, polarity=torch.zeros_like(observed()[2].polarity)) == pytest.approx(0.1)


@pytest.mark.parametrize("config", OFF, ids=str)
def test_where_nothing_is_dated_back_so_nothing_is_told(config):
    assert share_after(0.029, config=config) == pytest.approx(0.1)


def test_from_fast_pixels_to_slow_ones():
    stated = slowness(torch.tensor([0.0, 0.02, 0.08, 0.1, 0.3, 1.0]))
    assert stated[:2].tolist() == [0.0, 0.0] and 0 < stated[2] < stated[3] < 1 and stated[4:].tolist() == [1.0, 1.0]
    assert slowness(unknown_latency(torch.zeros(3))).tolist() == pytest.approx([1.0] * 3)


# ---- what becomes of late events


def test_of_fast_pixels_no_event_is_late():
    _, _, observations, _ = observed()
    observations = replace(observations, into_burst_s=torch.rand(observations.age_s.shape, generator=torch.Generator().manual_seed(0)))
    assert not dated(observations, torch.zeros(1), SEEN, LONG).into_burst_s.any()
    assert torch.equal(dated(observations, torch.ones(1), SEEN, LONG).into_burst_s, observations.into_burst_s)
    for config in OFF:
        assert dated(observations, torch.zeros(1), SEEN, config) is observations


def test_of_what_is_not_seen_well_all_are_late():
    _, _, observations, _ = observed()
    observations = replace(observations, into_burst_s=torch.ones_like(observations.age_s))
    shares = [
        float(dated(observations, torch.zeros(1), torch.full((1,), time_since_validated_s), LONG).into_burst_s.mean())
        for time_since_validated_s in (0.0, 0.005, 1.0)
    ]
    assert shares[0] == 0 and 0 < shares[1] < 1 and shares[2] == 1


def test_each_object_has_its_own():
    _, _, observations, _ = observed()
    two = replace(observations, into_burst_s=torch.ones(2, observations.age_s.shape[1]))
    assert dated(two, torch.tensor([0.0, 1.0]), torch.zeros(2), LONG).into_burst_s.sum(1).tolist() == [0.0, observations.age_s.shape[1]]


# ---- in the tracker


def test_it_is_remembered():
    # Circuits are looked at once in 20 ms: in the window that ends there.
    tracker, state, _, (events, end_us), _ = started(config=TrackerConfig(association=LONG), count=11)
    after = [
        float(tracker.step(changed(state, late_share=torch.full((1,), before)), events, end_us)[0].appearance.late_share) for before in (0.0, 1.0)
    ]
    assert 0.0 < after[0] < 0.02 and 0.98 < after[1] < 1.0


def test_with_fast_pixels_poses_are_as_without_bursts():
    actual = []
    for burst_us in (10_000, 0):
        tracker, state, _, (events, end_us), _ = started(config=TrackerConfig(association=AssociationConfig(pixel_latency=True, burst_us=burst_us)))
        # Each event once more, a little later: bursts of two.
        again = replace(events, t_us=events.t_us + 300)
        both = replace(events, **{name: torch.cat([value, getattr(again, name)]) for name, value in vars(events).items() if torch.is_tensor(value)})
        both = both[both.t_us.sort(stable=True).indices].slice_time(end_us - 5_000, end_us)
        _, result = tracker.step(
            changed(state, late_share=torch.zeros(1), time_since_validated_s=torch.zeros(1), T_cam_obj=started()[1].T_cam_obj), both, end_us
        )
        actual.append(poses_of([result]))
    torch.testing.assert_close(*actual, atol=2e-5, rtol=0)
