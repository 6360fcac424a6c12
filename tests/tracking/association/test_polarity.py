"""What is remembered of the darker side of contours, and what events that say the opposite count while an object is hidden."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers import IMAGE_SIZE, generator, moving_objects, seen, upright_line
from nearest_cases import matching
from states import changed
from tracked_boxes import WINDOW_US, follow, started

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.presets import preset
from torchtrack.config.tracker import TrackerConfig
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.sim.scenes import SceneConfig
from torchtrack.sim.simulation import simulate
from torchtrack.tracking.adapt import objects_as_known
from torchtrack.tracking.association.nearest import Gate, contour_table, match_nearest
from torchtrack.tracking.association.polarity import (
    expected_polarity,
    is_asked,
    is_seen_well,
    nothing_remembered,
    octant,
    remembered,
    remembers_polarity,
)
from torchtrack.tracking.contours.index import index_contours
from torchtrack.tracking.validation.measures import explained_ratio
from torchtrack.tracking.validation.status import Status

OFF = TrackerConfig(disabled={Component.POLARITY_PRIOR})
RIGHT = 5  # the octant of (1, 0)


def turned(angle_deg, dtype=torch.float64):
    angle = torch.as_tensor(angle_deg, dtype=dtype).deg2rad()
    return torch.stack([angle.cos(), angle.sin()], -1)


# ---- what is remembered


def test_each_eighth_of_the_plane_is_an_octant_of_its_own(dtype):
    middles = octant(turned(torch.arange(8) * 45.0 + 22.5, dtype))
    assert sorted(middles.tolist()) == list(range(8))
    for angle_deg, number in zip(torch.arange(8) * 45.0 + 22.5, middles.tolist(), strict=True):
        assert (octant(turned(angle_deg + torch.linspace(-22, 22, 12), dtype)) == number).all()


def after(dark, *, weights=1.0, window_s=0.005, before=0.0, dtype=torch.float64):
    """What is remembered after one window of events with so many contours in one direction."""
    dark = torch.as_tensor(dark, dtype=dtype)[None]
    directions = turned(torch.full(dark.shape, 10.0, dtype=dtype), dtype)
    weights = torch.as_tensor(weights, dtype=dtype).expand(dark.shape)
    sides = torch.full((1, 8), before, dtype=dtype)
    return remembered(sides, directions, dark, weights, torch.full((1,), window_s, dtype=dtype))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_many_events_say_is_learned_with_the_time_constant(sign, dtype):
    actual = after([sign] * 3000, window_s=0.05, dtype=dtype)
    mine = int(octant(turned(10.0)))
    assert float(actual[0, mine]) == pytest.approx(sign * (1 - math.exp(-1)), rel=2e-3)
    assert (actual[0, [other for other in range(8) if other != mine]] == 0).all()


def test_few_events_say_little_and_none_nothing():
    mine = int(octant(turned(10.0)))
    many, few = (float(after([1.0] * count)[0, mine]) for count in (300, 1))
    assert 0 < few < 0.3 * many
    for nothing in (after([0.0] * 50, before=0.4), after([1.0] * 50, weights=0.0, before=0.4)):
        assert nothing[0].tolist() == pytest.approx([0.4] * 8)


def test_both_sides_alike_are_forgotten_towards_nothing():
    assert abs(float(after([1.0, -1.0] * 500, before=0.8, window_s=0.5)[0, int(octant(turned(10.0)))])) < 0.01


def test_objects_learn_each_for_itself_and_are_not_differentiated():
    dark = torch.ones(2, 40, dtype=torch.float64)
    weights = torch.tensor([[1.0], [0.0]], dtype=torch.float64).expand(2, 40).clone().requires_grad_()
    directions = turned(torch.full((2, 40), 10.0))
    actual = remembered(nothing_remembered(dark), directions, dark, weights, torch.full((2,), 0.005, dtype=torch.float64))
    assert not actual.requires_grad
    assert (actual[1] == 0).all()
    torch.testing.assert_close(actual[:1], after([1.0] * 40))


def test_nothing_is_expected_of_what_is_seen_well_and_all_of_what_is_hardly_seen(dtype):
    sides = torch.tensor([[1.0, -1.0, 0.5, -0.5, 0.1, 0.0, 0.9, -0.9]], dtype=dtype).expand(4, 8)
    score, full = torch.tensor([0.75, 0.6, 0.4, 0.0], dtype=dtype), torch.full((4,), 0.8, dtype=dtype)
    expected = expected_polarity(sides, score, full)
    assert is_asked(score, full).tolist() == [False, True, True, True]
    assert (expected[0] == 0).all()
    torch.testing.assert_close(expected[2:], (sides * sides.abs())[2:])
    torch.testing.assert_close(expected[1], 0.5 * (sides * sides.abs())[1])


def test_what_was_never_seen_well_is_measured_against_a_least_share():
    shares, full = torch.tensor([0.2, 0.47, 0.49]), torch.full((3,), 0.2)
    assert is_seen_well(shares, full).tolist() == [False, False, True]
    assert float(expected_polarity(torch.ones(1, 8), torch.tensor([0.2]), torch.tensor([0.2]))[0, 0]) == 1


# ---- what events count by it


def matched(dark, *, expected=1.0, kind=ContourKind.SMOOTH):
    """Matches of events on the line at 80 px, whose normal (1, 0) it moves along: ``dark`` is their polarity."""
    contours = upright_line(80.0, kind=kind)
    v = 32 + 15 * torch.rand(len(dark), generator=generator(), dtype=torch.float64)
    places = torch.stack([torch.full_like(v, 80.0), v], -1)[None]
    polarity = None if expected is None else torch.zeros(1, 8, dtype=torch.float64).index_fill(1, torch.tensor([RIGHT]), expected)
    table = contour_table(contours, index_contours(contours, IMAGE_SIZE, 8, 1), polarity)
    observations = seen(places, polarity=torch.tensor(dark, dtype=torch.float64)[None])
    return contours, match_nearest(observations, table, places, moving_objects((500.0, 0.0)), Gate(3.0), matching(polarity=True))[0]


@pytest.mark.parametrize("kind", [ContourKind.SMOOTH, ContourKind.CREASE])
def test_a_few_that_are_as_expected_count_in_full_among_many_that_are_not(kind):
    mixed = [1.0] * 6 + [-1.0] * 60
    _, alone = matched(mixed, expected=None, kind=kind)
    assert float(alone.weights[0, :6].max()) < 0.1
    assert float(alone.weights[0, 6:].min()) == 1
    _, known = matched(mixed, kind=kind)
    assert float(known.weights[0, :6].min()) == 1
    assert float(known.weights[0, 6:].max()) < 0.06
    torch.testing.assert_close(known.as_expected[0, 6:], torch.full((60,), 0.05, dtype=torch.float64))


def test_the_less_is_expected_the_less_is_lost():
    counts = [float(matched([-1.0] * 20, expected=expected)[1].weights[0, 0]) for expected in (0.0, 0.2, 0.4, 1.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] == 1
    assert counts[-1] < 0.06


@pytest.mark.parametrize("kind", [ContourKind.SEGMENT, ContourKind.SPLAT, ContourKind.LEARNED])
def test_nothing_is_expected_of_contours_whose_normals_may_point_either_way(kind):
    assert (matched([1.0, -1.0] * 10, kind=kind)[1].as_expected == 1).all()


def test_of_unknown_polarity_nothing_is_said():
    assert (matched([0.0] * 20)[1].as_expected == 1).all()


def test_contours_are_not_explained_by_events_that_are_not_as_expected():
    shares = []
    for dark in ([1.0] * 60, [-1.0] * 60):
        contours, matches = matched(dark)
        moving = torch.tensor([500.0, 0.0], dtype=torch.float64).expand_as(contours.pixels)
        shares.append(float(explained_ratio(contours, matches, moving, torch.tensor([IMAGE_SIZE]), TrackerConfig())))
    assert shares[0] > 0.1
    assert shares[1] == 0


# ---- in the tracker


@cache
def bright_vase():
    """A bright vase that moves before a dark wall."""
    motion = {"position_m": [0, 0, 0.5], "rotation_deg": [20, 30, 60], "frequency_hz": 2.0}
    vase = {"label": "vase", "shape": "vase", "reflectance": 0.9, "motion": motion}
    camera = {"width": 160, "height": 120, "fx": 160, "fy": 160}
    scene = {"objects": [vase], "camera": camera, "duration_s": 0.15, "background": {"luminance": 0.02}}
    return simulate(SceneConfig.model_validate(scene))


@cache
def tracked(config=None, *, turned_round=False, dtype=torch.float32):
    """A tracker, and its state and results after the vase, with all polarities turned round or not."""
    sequence = bright_vase()
    events = replace(sequence.events, polarity=~sequence.events.polarity) if turned_round else sequence.events
    tracker = Tracker([ObjectModel.from_mesh(sequence.models[0][0])], sequence.camera, config, dtype=dtype)
    ends = [WINDOW_US * k for k in range(1, 31)]
    start = sequence.trajectories[0].at(torch.tensor([0]))
    return tracker, *follow(tracker, tracker.init(start, 0), [(events.slice_time(end - WINDOW_US, end), end) for end in ends])


@pytest.mark.parametrize(("turned_round", "sign"), [(False, 1.0), (True, -1.0)])
def test_a_bright_object_before_a_dark_wall_is_darker_outside(turned_round, sign, dtype):
    _, state, results = tracked(turned_round=turned_round, dtype=dtype)
    assert int(results[-1].status[0]) == Status.TRACKING
    sides = sign * state.appearance.darker_outside[0]
    assert float(sides.min()) > -0.1
    assert float(sides.median()) > 0.6


def test_nothing_is_remembered_where_it_is_switched_off():
    tracker, state, _ = tracked(OFF)
    assert (state.appearance.darker_outside == 0).all()
    hidden = changed(state, darker_outside=torch.ones_like(state.appearance.darker_outside), score=torch.zeros_like(state.health.score))
    assert known(tracker, hidden).polarity is None


def known(tracker, state):
    return objects_as_known(tracker.objects, state, False, tracker.config)


def test_nothing_is_asked_of_events_while_all_is_seen():
    tracker, state, _ = tracked()
    assert known(tracker, changed(state, score=state.health.reference_explained_ratio)).polarity is None
    hidden = changed(state, score=0.3 * state.health.reference_explained_ratio)
    torch.testing.assert_close(known(tracker, hidden).polarity, state.appearance.darker_outside * state.appearance.darker_outside.abs())


def test_copies_of_an_object_expect_what_it_does():
    tracker, _, _ = tracked()
    objects = replace(tracker.objects, polarity=torch.linspace(-1, 1, 8)[None])
    assert torch.equal(objects.copies([0], 3).polarity, torch.linspace(-1, 1, 8).expand(3, 8))
    assert tracker.objects.copies([0], 3).polarity is None


def test_what_was_not_tracked_is_not_remembered():
    tracker, state, _, (events, end_us), _ = started()
    blind = changed(state, darker_outside=torch.full_like(state.appearance.darker_outside, 0.5))
    assert torch.equal(tracker.step(blind, events[:0], end_us)[0].appearance.darker_outside, blind.appearance.darker_outside)


@pytest.mark.parametrize(("name", "expected"), [("paper", False), ("nns", True)])
def test_polarity_is_remembered_where_it_counts(name, expected):
    assert remembers_polarity(preset(name)) == expected
