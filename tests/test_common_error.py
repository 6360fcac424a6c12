"""What observations that lie side by side have in common: many of them do not tell as much more."""

from dataclasses import replace

import pytest
import torch
from helpers import IMAGE_SIZE, generator, moving_objects, seen, upright_line
from tracked_boxes import in_motion

from torchtrack.alignment import align, gate_widening, index_for
from torchtrack.config.tracker import MatchingConfig, SolverConfig, TrackerConfig
from torchtrack.contour_index import index_contours
from torchtrack.contour_model import ContourKind
from torchtrack.matching import ContourTable, match_nearest, told_by_each
from torchtrack.observations import join, select_events

WITHOUT = TrackerConfig(solver=SolverConfig(common_px=0.0))


@pytest.mark.parametrize(("observation_px", "common_px"), [(1.0, 0.5), (1.5, 0.2), (0.2, 1.0)])
def test_the_mean_of_many_has_the_variance_of_what_they_have_in_common(observation_px, common_px, dtype):
    count = torch.tensor([[1.0, 2.0, 10.0, 1e3, 1e6]], dtype=dtype)
    config = SolverConfig(observation_px=observation_px, common_px=common_px)
    variance = observation_px**2 / (count * told_by_each(count, config))
    torch.testing.assert_close(variance, common_px**2 + observation_px**2 / count)


def test_one_alone_and_those_with_nothing_in_common_tell_all(dtype):
    count = torch.arange(50, dtype=dtype)[None]
    assert (told_by_each(count, WITHOUT.solver) == 1).all()
    assert (told_by_each(torch.zeros_like(count), SolverConfig()) == 1).all()


def test_observations_are_counted_by_patch_where_they_are_on_a_contour():
    """Two patches (16 px) with 30 and 5 observations on an upright line, and some 2 px beside it, which do not count."""
    rows = torch.cat([torch.linspace(33, 46, 30), torch.linspace(81, 94, 5), torch.linspace(33, 46, 8)]).double()
    columns = torch.cat([torch.full((35,), 85.2), torch.full((8,), 87.0)]).double()
    table = ContourTable.of(contours := upright_line(85.0), index_contours(contours, IMAGE_SIZE, 8, 1))
    observations, still = seen(torch.stack([columns, rows], -1)[None]), moving_objects((0.0, 0.0), 1, torch.float64)
    matches, _ = match_nearest(observations, table, observations.pixels, still, 4.0, MatchingConfig(dark_shift_px=0.0))
    assert matches.beside[0].tolist() == [30] * 30 + [5] * 5 + [30] * 8


def solved(times, config, kind=ContourKind.LIMB):
    """A window of a box whose edges are taken for those of ``kind``, with each of its events observed so many times."""
    tracker, prediction, events, _, _ = in_motion(config)
    contours = prediction.objects.contours(prediction.T_cam_obj, tracker.config.contours)
    contours = replace(contours, kind=torch.full_like(contours.kind, int(kind)))
    tight = gate_widening(torch.zeros(1), tracker.config)
    index = index_for(contours, tracker.image_size, tracker.config, tight)
    once = observations = select_events(events, index, prediction.plane_velocity(events.pixels), 1000)
    for _ in range(times - 1):
        observations = join(observations, once)
    return prediction, align(prediction, contours, index, tight, observations, tracker.config).solution


def told(times, config, kind=ContourKind.LIMB):
    """How much these tell of the pose, beside what was predicted: the trace of the information, by the prediction's covariance."""
    prediction, solution = solved(times, config, kind)
    observed = solution.hessian[0, :6, :6].double() / config.solver.observation_px**2 - prediction.information[0, :6, :6]
    return float((observed @ prediction.covariance[0, :6, :6]).trace())


def test_events_of_a_limb_seen_many_times_over_tell_little_more():
    assert told(8, WITHOUT) / told(1, WITHOUT) == pytest.approx(8, rel=0.2)
    assert 1 < told(8, TrackerConfig()) / told(1, TrackerConfig()) < 5


@pytest.mark.parametrize("kind", [ContourKind.CREASE, ContourKind.TEXTURE, ContourKind.SEGMENT, ContourKind.LEARNED])
def test_what_is_no_limb_has_nothing_in_common(kind):
    for theirs, ours in zip(*(vars(solved(2, config, kind)[1]).values() for config in (WITHOUT, TrackerConfig())), strict=True):
        assert torch.equal(theirs, ours)


def test_what_is_in_common_leaves_exact_poses_alone():
    *_, truth = in_motion()
    assert float((solved(1, TrackerConfig())[1].T_cam_obj.double() - truth).abs().max()) < 3e-3


def test_a_displaced_place_with_many_events_pulls_less_with_an_error_in_common():
    """Of two equal stretches of a line, one has ten times the events, and is half a pixel off: the mean of all is taken less to it."""
    rows = torch.cat([torch.linspace(33, 46, 100), torch.linspace(81, 94, 10)]).double()
    noise = 0.05 * torch.randn(110, generator=generator(3), dtype=torch.float64)
    columns = 85 + noise + torch.cat([torch.full((100,), 0.5), torch.zeros(10)]).double()
    table = ContourTable.of(contours := upright_line(85.0), index_contours(contours, IMAGE_SIZE, 8, 1))
    observations, still = seen(torch.stack([columns, rows], -1)[None]), moving_objects((0.0, 0.0), 1, torch.float64)
    matches, _ = match_nearest(observations, table, observations.pixels, still, 4.0, MatchingConfig(dark_shift_px=0.0, polarity=False))
    means = []
    for config in (SolverConfig(common_px=0.0), SolverConfig(observation_px=1.0, common_px=1.0)):
        weights = matches.weights * told_by_each(matches.beside, config)
        means.append(float((weights * matches.offsets.abs()).sum() / weights.sum()))
    assert means[0] == pytest.approx(0.455, abs=0.03)
    # Both stretches tell the same.
    assert means[1] == pytest.approx(0.26, abs=0.03)
