"""Parts of a model that events do not show: what is left out, what is not, and when."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors
from tracked_boxes import assert_same, follow, moving_box, poses_of, windows

from torchtrack import Tracker
from torchtrack.config.tracker import ContourConfig, MatchingConfig, ModelTrustConfig, TrackerConfig
from torchtrack.object_model.contour_source import ContourKind, ContourModel
from torchtrack.tracking.adaptation.model_trust import ModelTrust
from torchtrack.tracking.contours.points import mesh_elements
from torchtrack.tracking.state import joined, take_part

COUNT = 30
OFF, CONFIG = TrackerConfig(), ModelTrustConfig(least_share=0.5)
ON = TrackerConfig(model_trust=CONFIG)
# Elements: the rest of the model, two sharp edges, and two places of print.
GROUPS = torch.tensor([[0, 2, 2, 3, 3]])


@cache
def grooved_box(grooves=4):
    """The box, and edges across all of its sides that it does not have."""
    box = box_model()
    half = box.triangles.flatten(0, 1).amax(0)
    lines, normals = [], []
    for axis in range(3):
        for side in ((axis + 1) % 3, (axis + 2) % 3):
            for sign in (-1.0, 1.0):
                for place in torch.linspace(-0.75, 0.75, grooves):
                    middle, along, normal = torch.zeros(3), torch.zeros(3), torch.zeros(3)
                    normal[side], along[3 - axis - side] = sign, half[3 - axis - side]
                    middle[side], middle[axis] = sign * half[side], place * half[axis]
                    lines.append(torch.stack([middle - along, middle + along]))
                    normals.append(torch.stack([normal, torch.nn.functional.one_hot(torch.tensor(axis), 3).float()]))
    points, both = torch.cat([box.edge_points, torch.stack(lines)]), torch.cat([box.edge_normals, torch.stack(normals)])
    return replace(box, edge_points=points, edge_normals=both, edge_is_crease=torch.cat([box.edge_is_crease, torch.ones(len(lines)).bool()]))


@cache
def followed(config=ON):
    """A tracker of the box by the grooved model, its last state, its results, and the true poses."""
    trajectory, events = moving_box(pose(), COUNT)
    tracker = Tracker([grooved_box()], SMALL_CAMERA, config)
    state, results = follow(tracker, tracker.init(pose()[None], 0), windows(events, COUNT))
    return tracker, state, results, trajectory.at(torch.stack([result.t_us[0] for result in results]))


def trust_of(explained, expected):
    explained, expected = torch.tensor([explained]), torch.tensor([expected])
    return ModelTrust(explained, expected, torch.ones(1), 0)


def test_grooves_that_the_object_does_not_have_are_left_out():
    tracker, state, results, truth = followed()
    shown = state.model_trust.shown(tracker.element_groups, CONFIG)[0]
    model = tracker.models[0]
    true_edges = model.edge_element[: len(box_model().edge_points)]
    false_edges = model.edge_element[len(box_model().edge_points) :]
    seen = state.model_trust.expected[0] > 20
    assert bool(shown[true_edges[seen[true_edges]]].all())
    assert float(shown[false_edges[seen[false_edges]]].float().mean()) < 0.2
    _, _, without, _ = followed(OFF)
    assert float(results[-1].quality) > float(without[-1].quality) + 0.1
    rotation_deg, translation_mm = pose_errors(poses_of(results), truth)
    assert float(rotation_deg.max()) < 0.5
    assert float(translation_mm.max()) < 1


def test_nothing_of_a_true_model_is_left_out():
    _, events = moving_box(pose(), COUNT)
    runs = []
    for config in (ON, OFF):
        tracker = Tracker([box_model()], SMALL_CAMERA, config)
        state, results = follow(tracker, tracker.init(pose()[None], 0), windows(events, COUNT))
        runs.append(results)
        if config is ON:
            assert bool(state.model_trust.shown(tracker.element_groups, CONFIG).all())
            assert float(state.model_trust.expected.max()) <= CONFIG.memory
    assert_same(runs[0][-1], runs[1][-1])


@pytest.mark.parametrize(
    "config",
    [OFF, ON.model_copy(update={"contours": ContourConfig(source="splat")}), ON.model_copy(update={"matching": MatchingConfig(max_events=0)})],
    ids=str,
)
def test_without_it_nothing_is_remembered(config):
    tracker = Tracker([box_model()], SMALL_CAMERA, config)
    assert tracker.init(pose()[None], 0).model_trust is None


def test_what_was_never_looked_at_is_taken_from_its_kind():
    trust = trust_of([500.0, 10.0, 0.0, 190.0, 0.0], [500.0, 190.0, 0.0, 190.0, 0.0])
    share = trust.share(GROUPS)[0]
    assert float(share[2]) == pytest.approx((10 + 200) / (190 + 200))
    assert float(share[4]) == 1
    assert trust.shown(GROUPS, CONFIG)[0].tolist() == [True, False, True, True, True]


def test_nothing_is_left_out_before_anything_was_seen():
    trust = ModelTrust.none(GROUPS, torch.zeros(1))
    assert bool(trust.shown(GROUPS, ModelTrustConfig(least_share=1.0)).all())


def test_all_is_kept_where_too_little_would_be_left():
    trust = trust_of([0.0, 80.0, 0.0, 5.0, 0.0], [0.0, 200.0, 200.0, 10.0, 0.0])
    assert bool(trust.shown(GROUPS, CONFIG).all())


def test_one_window_does_not_decide():
    _, events = moving_box(pose(), COUNT)
    tracker = Tracker([grooved_box()], SMALL_CAMERA, ON)
    state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(events, 6))
    longest = CONFIG.memory
    before = state.model_trust
    window, end_us = windows(events, 7)[-1]
    after = tracker.step(state, window, end_us)[0].model_trust
    assert float((after.expected - before.expected).max()) <= 0.1 * longest * (1 + 1e-6)
    assert after.windows == before.windows + 1


def test_states_of_models_with_more_and_fewer_elements_go_together():
    alone = [Tracker([model], SMALL_CAMERA, ON).init(pose()[None], 0) for model in (box_model(), grooved_box())]
    both = joined(alone)
    tracker = Tracker([box_model(), grooved_box()], [SMALL_CAMERA] * 2, ON, stream_index=[0, 1])
    assert both.model_trust.explained.shape == tracker.element_groups.shape
    part = take_part(both, slice(0, 1), slice(0, 1))
    _, events = moving_box(pose(), 2)
    (window, end_us), *_ = windows(events, 2)
    tracker = Tracker([box_model()], SMALL_CAMERA, ON)
    assert_same(tracker.step(part, window, end_us)[1], tracker.step(alone[0], window, end_us)[1])


def test_elements_are_long_edges_places_and_kinds():
    model = ContourModel(box_model(), [0], ContourConfig())
    creases = model.edge_element[model.is_crease]
    assert sorted(creases.tolist()) == list(range(1, len(creases) + 1))
    assert not bool(model.edge_element[~model.is_crease].any())
    assert model.element_group.tolist() == [0] + [int(ContourKind.CREASE) + 1] * len(creases)


def test_contours_are_of_the_elements_that_are_shown():
    model = ContourModel(box_model(), [0], ContourConfig())
    T, intrinsics = pose()[None].float(), SMALL_CAMERA.intrinsics()[None]
    numbers = torch.arange(len(model.element_group))[None]
    everything, element = mesh_elements([model], T, intrinsics, ContourConfig(), numbers >= 0)
    hidden = int(element[0, 0])
    some, left = mesh_elements([model], T, intrinsics, ContourConfig(), numbers != hidden)
    assert set(left[some.mask].tolist()) == set(element[everything.mask].tolist()) - {hidden}
