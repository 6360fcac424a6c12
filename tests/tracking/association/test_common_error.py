"""What observations of a smooth silhouette in one place have in common: many of them do not tell as much more."""

from dataclasses import replace

import pytest
import torch
from helpers import IMAGE_SIZE, moving_objects, seen, upright_line
from nearest_cases import matching
from tracked_boxes import in_motion

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association.nearest import Gate, contour_table, match_nearest
from torchtrack.tracking.association.observations import join, select_events
from torchtrack.tracking.association.weights import COMMON_PX, effective_weight
from torchtrack.tracking.contours.index import index_contours
from torchtrack.tracking.estimation.rounds import Start, align, gate_scale_of, index_for

WITHOUT = TrackerConfig(disabled=frozenset({Component.COMMON_ERROR}))


def test_the_mean_of_many_has_the_variance_of_what_they_have_in_common(dtype):
    config = TrackerConfig()
    count = torch.tensor([[1.0, 2.0, 10.0, 1e3, 1e6]], dtype=dtype)
    variance = config.solver.observation_px**2 / (count * effective_weight(count, torch.ones_like(count), config))
    torch.testing.assert_close(variance, COMMON_PX**2 + config.solver.observation_px**2 / count)


@pytest.mark.parametrize(("silhouette", "config"), [(0.0, TrackerConfig()), (1.0, WITHOUT)])
def test_those_with_nothing_in_common_tell_all(silhouette, config, dtype):
    count = torch.arange(50, dtype=dtype)[None]
    assert (effective_weight(count, torch.full_like(count, silhouette), config) == 1).all()


def test_observations_are_counted_by_patch_where_they_are_on_a_contour():
    """Two patches (16 px) with 30 and 5 observations on an upright line, and some 2 px beside it, which do not count."""
    rows = torch.cat([torch.linspace(33, 46, 30), torch.linspace(81, 94, 5), torch.linspace(33, 46, 8)]).double()
    columns = torch.cat([torch.full((35,), 85.2), torch.full((8,), 87.0)]).double()
    table = contour_table(contours := upright_line(85.0, kind=ContourKind.SMOOTH), index_contours(contours, IMAGE_SIZE, 8, 1))
    observations, still = seen(torch.stack([columns, rows], -1)[None]), moving_objects((0.0, 0.0), 1, torch.float64)
    matches, _ = match_nearest(observations, table, observations.pixels, still, Gate(4.0), matching(concentration=True, polarity=True))
    count = torch.tensor([[30.0] * 30 + [5.0] * 5 + [30.0] * 8], dtype=torch.float64)
    torch.testing.assert_close(matches.effective, effective_weight(count, torch.ones_like(count), TrackerConfig()))


def solved(times, config, kind=ContourKind.SMOOTH):
    """A window of a box whose edges are taken for those of ``kind``, with each of its events observed so many times."""
    tracker, prediction, events, _, _ = in_motion(config)
    contours = prediction.objects.contours(prediction.T_cam_obj, tracker.config.contours)
    contours = replace(contours, kind=torch.full_like(contours.kind, int(kind)))
    tight = gate_scale_of(torch.zeros(1), tracker.config)
    index = index_for(contours, tracker.image_size, tracker.config, tight)
    once = observations = select_events(events, index, prediction.moving(compensated=True), 1000)
    for _ in range(times - 1):
        observations = join(observations, once)
    return prediction, align(Start(prediction, contours, index, tight), observations, tracker.config).solution


def stated(times, config, kind=ContourKind.SMOOTH):
    """How much these tell of the pose, beside what was predicted: the trace of the information, by the prediction's covariance."""
    prediction, solution = solved(times, config, kind)
    observed = solution.hessian[0, :6, :6].double() / config.solver.observation_px**2 - prediction.information[0, :6, :6]
    return float((observed @ prediction.covariance[0, :6, :6]).trace())


def test_events_of_a_smooth_silhouette_seen_many_times_over_tell_little_more():
    assert stated(8, WITHOUT) / stated(1, WITHOUT) == pytest.approx(8, rel=0.2)
    assert 1 < stated(8, TrackerConfig()) / stated(1, TrackerConfig()) < 5


@pytest.mark.parametrize("kind", [ContourKind.CREASE, ContourKind.TEXTURE, ContourKind.SEGMENT, ContourKind.LEARNED])
def test_what_is_no_smooth_silhouette_has_nothing_in_common(kind):
    for theirs, ours in zip(*(vars(solved(2, config, kind)[1]).values() for config in (WITHOUT, TrackerConfig())), strict=True):
        assert torch.equal(theirs, ours)


def test_what_is_in_common_leaves_exact_poses_alone():
    *_, truth = in_motion()
    assert float((solved(1, TrackerConfig())[1].T_cam_obj.double() - truth).abs().max()) < 3e-3
