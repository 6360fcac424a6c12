"""Windows that are taken in parts while an object's motion is not known."""

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors
from states import changed
from tracked_boxes import assert_same, follow, moving_box, poses_of, started, windows

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.events import concatenate
from torchtrack.tracking import initialization
from torchtrack.tracking.state import choose_rows

FAST = {"move": (2.0, 1.0, 0.1), "turn": (1.5, -1.0, 2.0)}


@pytest.fixture(autouse=True)
def few_events_make_a_part(monkeypatch):
    """The boxes of the tests fire far less than a real object does."""
    monkeypatch.setattr(initialization, "_EVENTS_OF_A_PART", 40)


WHOLE = TrackerConfig(disabled=frozenset({Component.WINDOW_PARTS}))


def errors_of(count=8):
    trajectory, events = moving_box(pose(), count, **FAST)
    tracker = Tracker([box_model()], SMALL_CAMERA)
    _, results = follow(tracker, tracker.init(pose()[None], 0), windows(events, count))
    times = torch.stack([result.t_us[0] for result in results])
    return pose_errors(poses_of(results), trajectory.at(times))


def test_a_start_in_full_motion_is_followed():
    rotation_deg, translation_mm = errors_of()
    assert float(rotation_deg[2:].max()) < 1
    assert float(translation_mm[2:].max()) < 1


def test_an_object_whose_motion_is_known_is_taken_whole(monkeypatch):
    tracker, state, _, (events, end_us), _ = started()
    calm = Tracker([box_model()], SMALL_CAMERA, WHOLE)
    assert_same(tracker.step(state, events, end_us), calm.step(state, events, end_us))


def test_an_object_whose_place_is_not_known_either_is_looked_for_by_all_events_of_a_window():
    tracker, state, _, (_, end_us), _ = started()
    # Its motion alone is not known, and then its place too.
    wild, lost = (variance * torch.eye(12, dtype=torch.float64)[None] for variance in (1e-4, 0.3))
    wild[:, 6:, 6:] *= 1e6
    for covariance, parted in ((state.motion.covariance, False), (wild, True), (lost, False)):
        unknown = initialization.of_unknown_motion(
            changed(state, covariance=covariance), torch.full_like(state.t_us, end_us), tracker.objects, tracker.config
        )
        assert unknown.tolist() == [parted]


def test_a_neighbour_in_parts_changes_nothing():
    _, left = moving_box(pose(), 3)
    _, right = moving_box(pose(), 3, seed=1, stream=1, **FAST)
    alone, both = (Tracker([box_model()] * count, [SMALL_CAMERA] * count, stream_index=range(count)) for count in (1, 2))
    state, pair = alone.init(pose()[None], 0), both.init(pose().repeat(2, 1, 1), 0)
    for number, ((ours, end_us), (theirs, _)) in enumerate(zip(windows(left, 3), windows(right, 3), strict=True)):
        if number == 1:
            # From here on the first object's motion counts as known, and the second's does not.
            state = changed(state, covariance=state.motion.covariance * 1e-2)
            pair = changed(pair, covariance=pair.motion.covariance * torch.tensor([1e-2, 10.0])[:, None, None])
        state, result = alone.step(state, ours, end_us)
        pair, results = both.step(pair, concatenate([ours, theirs]), end_us)
        torch.testing.assert_close(results.T_cam_obj[0], result.T_cam_obj[0], rtol=0, atol=1e-5)


def test_rows_are_chosen_object_by_object():
    tracker = Tracker([box_model()] * 2, SMALL_CAMERA)
    state = tracker.init(pose().repeat(2, 1, 1), 0)
    _, events = moving_box(pose(), 1)
    first = tracker.step(state, events, 5_000)
    second = tracker.step(first[0], events[:0], 5_000)
    chosen_state, chosen = choose_rows(torch.tensor([True, False]), first, second)
    assert torch.equal(chosen_state.motion.covariance, torch.stack([first[0].motion.covariance[0], second[0].motion.covariance[1]]))
    assert torch.equal(chosen.contours.pixels, torch.stack([first[1].contours.pixels[0], second[1].contours.pixels[1]]))
    assert torch.equal(chosen.corners.mask, torch.stack([first[1].corners.mask[0], second[1].corners.mask[1]]))
    assert chosen.status.tolist() == [int(first[1].status[0]), int(second[1].status[1])]
