"""Poses that parallel lines alone hold: how it is told, when it is asked, and what becomes of such a pose."""

from dataclasses import replace

import pytest
import torch
from measured_matches import matches_at
from states import changed
from tracked_boxes import started

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.validation.measures import PARALLEL_AFTER_S, constrained_2d, normal_spread, required_spread
from torchtrack.tracking.validation.status import Status

CONFIG = TrackerConfig()


def matches_of(angles_rad, **changes):
    """Observations on contours whose normals have these angles, of one object for each row."""
    angles_rad = torch.as_tensor(angles_rad, dtype=torch.float64)
    directions = torch.stack([angles_rad.cos(), angles_rad.sin()], -1)
    return replace(matches_at(torch.zeros_like(directions)), directions=directions, **changes)


def held(time_since_validated_s=0.1, apart=0.3, reference_normal_spread=0.3, config=CONFIG):
    asked = required_spread(torch.tensor([reference_normal_spread]), torch.tensor([time_since_validated_s]), config)
    return 1.0 if asked is None else float(constrained_2d(torch.tensor([apart]), asked))


# ---- how far apart


@pytest.mark.parametrize(
    ("angles_deg", "expected"),
    [
        ([30.0, 30.0, 210.0, 30.0], 0.0),
        ([0.0, 90.0, 180.0, 270.0], 0.5),
        ([0.0, 60.0, 120.0], 0.5),
        ([0.0, 0.0, 0.0, 90.0], 0.25),
        ([10.0, 20.0], 0.5 * (1 - 0.984807753)),
    ],
)
def test_directions_are_apart_as_lines_are(angles_deg, expected):
    apart = normal_spread(matches_of(torch.tensor([angles_deg]).deg2rad()))
    torch.testing.assert_close(apart, torch.tensor([expected], dtype=torch.float64), atol=1e-6, rtol=0)


def test_they_are_the_smaller_eigenvalue_of_their_scatter():
    angles_rad = torch.rand(3, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    matches = matches_of(angles_rad)
    scatter = torch.einsum("bni,bnj->bij", matches.directions, matches.directions) / 40
    torch.testing.assert_close(normal_spread(matches), torch.linalg.eigvalsh(scatter)[:, 0])


def test_only_what_lies_on_a_contour_counts():
    angles_rad = torch.tensor([[0.0, 0.0, 1.5, 1.5]])
    off = matches_of(angles_rad, offsets=torch.tensor([[0.0, 0.5, 0.9, -3.0]], dtype=torch.float64))
    nowhere = matches_of(angles_rad, near=torch.tensor([[True, True, False, False]]))
    for matches in (off, nowhere, matches_of(angles_rad, near=torch.zeros(1, 4, dtype=torch.bool))):
        assert normal_spread(matches).tolist() == [0.0]


# ---- when it is asked, and how much


def test_what_is_seen_well_or_was_until_now_is_asked_nothing():
    assert held(time_since_validated_s=0.0, apart=0.0) == held(time_since_validated_s=0.9 * PARALLEL_AFTER_S, apart=0.0) == 1.0
    assert held(time_since_validated_s=1.1 * PARALLEL_AFTER_S, apart=0.0) == 0.0
    assert held(apart=0.0, config=TrackerConfig(disabled=frozenset({Component.ALL_DIRECTIONS}))) == 1.0


def test_what_fires_along_parallel_edges_as_a_rule_may_do_so_for_ever():
    assert held(apart=0.0, reference_normal_spread=0.0) == 1.0
    assert held(apart=0.02, reference_normal_spread=0.02) == 1.0


def test_as_much_is_asked_as_there_is_when_seen_well_and_less_the_longer_ago_that_was():
    assert held(apart=0.3) == held(apart=0.15) == 1.0
    assert held(apart=0.01) == 0.0
    assert 0.0 < held(apart=0.05) < 1.0
    assert (
        held(apart=0.05, time_since_validated_s=0.06)
        < held(apart=0.05, time_since_validated_s=0.5)
        < held(apart=0.05, time_since_validated_s=3.0)
        == 1.0
    )


# ---- in the tracker


def of_upright_edges(events, contours):
    """Those of the events that lie nearest to contours that are upright in the image."""
    shown = contours.mask[0]
    nearest = torch.cdist(torch.stack([events.x, events.y], -1).double(), contours.pixels[0][shown].double()).argmin(1)
    return events[contours.normals[0][shown][nearest][:, 0].abs() > 0.99]


def last_window(time_since_validated_s, reference_normal_spread, *, all_directions=True, upright=False):
    """State and result of the next window of a box that is seen well as a rule, of which only upright edges may be seen."""
    config = TrackerConfig(disabled=frozenset() if all_directions else frozenset({Component.ALL_DIRECTIONS}))
    tracker, state, result, (events, end_us), _ = started(config=config)
    if upright:
        events = of_upright_edges(events, result.contours)
    well = dict.fromkeys(("reference_explained_ratio", "mean_score", "score"), torch.full((1,), 0.9))
    state = changed(
        state,
        time_since_validated_s=torch.full((1,), time_since_validated_s),
        reference_normal_spread=torch.full((1,), reference_normal_spread),
        **well,
    )
    return tracker.step(state, events, end_us)


def test_how_far_apart_is_remembered_of_what_is_seen_well():
    _, state, *_ = started()
    # Seen well in its last windows alone: before, the pose was not confirmed.
    assert 0.03 < float(state.health.reference_normal_spread) < 0.5
    after, _ = last_window(0.0, 0.0)
    assert float(after.health.time_since_validated_s) == 0 and 0 < float(after.health.reference_normal_spread) < 0.1
    partly, _ = last_window(0.0, 0.0, upright=True)
    assert float(partly.health.time_since_validated_s) > 0
    assert float(partly.health.reference_normal_spread) == 0


def test_a_pose_that_only_parallel_lines_hold_explains_nothing_while_the_object_may_be_hidden():
    _, stated = last_window(0.1, 0.4, upright=True)
    _, not_asked = last_window(0.1, 0.4, upright=True, all_directions=False)
    assert float(stated.quality) < 0.5 * float(not_asked.quality)
    assert int(stated.status) >= int(not_asked.status)
    assert int(stated.observation_count) >= 30


@pytest.mark.parametrize(("time_since_validated_s", "reference_normal_spread"), [(0.0, 0.4), (0.1, 0.0)])
def test_it_does_where_the_object_was_just_seen_well_or_never_fires_otherwise(time_since_validated_s, reference_normal_spread):
    _, stated = last_window(time_since_validated_s, reference_normal_spread, upright=True)
    _, not_asked = last_window(time_since_validated_s, reference_normal_spread, upright=True, all_directions=False)
    assert float(stated.quality) == float(not_asked.quality) > 0
    assert stated.status.tolist() == not_asked.status.tolist()


def test_all_of_a_box_holds_it_all_ways():
    _, stated = last_window(0.1, 0.4)
    assert int(stated.status) == Status.TRACKING
    assert float(stated.quality) > 0.7
