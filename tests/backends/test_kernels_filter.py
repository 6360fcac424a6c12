"""Kernels of the filter, from a window's forecast to its conclusion, give what PyTorch's operations give; objects do not see one another."""

import pytest
import torch
from both_ways import assert_as_close, both_ways
from helpers import SMALL_CAMERA, box_model, generator, pose, random_twist
from states import changed
from tracked_boxes import tensors_of

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.lie import retract_about
from torchtrack.core.linalg import inverse
from torchtrack.tracking.association.matches import MatchesWithCues
from torchtrack.tracking.estimation.rounds import Fit
from torchtrack.tracking.estimation.terms import Linearisation
from torchtrack.tracking.frontend.corners import no_corners
from torchtrack.tracking.motion.predict import forecast
from torchtrack.tracking.relocalization.lost_objects import Relocalized
from torchtrack.tracking.update import conclude
from torchtrack.tracking.validation.measures import visible_ratio
from torchtrack.tracking.validation.scored_fit import ScoredFit
from torchtrack.tracking.validation.status import Status

pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")
TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}
OBJECTS = 7


def uniform(*shape, low=0.0, high=1.0, seed=0):
    return low + (high - low) * torch.rand(shape, generator=generator(seed), dtype=torch.float64)


def random_covariances(batch=4, size=12, seed=3):
    root, sigma = torch.randn(batch, size, size, generator=generator(seed), dtype=torch.float64), torch.logspace(-4, 1, size).double()
    return sigma[:, None] * (root @ root.mT / size + torch.eye(size).double()) * sigma


def boxes(config=None, dtype=torch.float64):
    """A tracker of several boxes, and a state of theirs of which everything was drawn."""
    tracker = Tracker([box_model()] * OBJECTS, SMALL_CAMERA, config, dtype=dtype)
    state = tracker.init(pose().expand(OBJECTS, 4, 4), 0)
    T_cam_obj = retract_about(state.T_cam_obj, random_twist(OBJECTS, rotation_rad=1.0, translation_m=0.05), tracker.centre_obj.double())
    velocity = random_twist(OBJECTS, rotation_rad=3.0, translation_m=0.8, seed=1).to(dtype)
    shares = {
        name: uniform(OBJECTS, seed=number).to(dtype)
        for number, name in enumerate(("mean_score", "reference_explained_ratio", "reference_inlier_ratio", "score"))
    }
    times = {name: 0.2 * uniform(OBJECTS, seed=5 + number).to(dtype) for number, name in enumerate(("drift_s", "time_since_validated_s"))}
    darker = uniform(OBJECTS, 8, low=-1, seed=9).to(dtype)
    motion = {"velocity": velocity, "covariance": 1e-4 * random_covariances(OBJECTS)}
    return tracker, changed(state, T_cam_obj=T_cam_obj, darker_outside=darker, **motion, **shares, **times)


# ---- the forecast


def forecasts(tracker, state):
    dt_s = uniform(OBJECTS, low=1e-3, high=2e-2, seed=11).to(tracker.intrinsics.dtype)
    return lambda: forecast(state.motion, dt_s, tracker.objects, tracker.far_pose, tracker.config)


def stated(prediction):
    """What a prediction says."""
    return prediction.T_cam_obj, prediction.velocity, prediction.covariance, prediction.usable


MOTIONS = {
    "as it is": {},
    "hold": {"motion": {"model": "hold"}},
    "turns go on": {"disabled": ["turns_fade"]},
}


@pytest.mark.parametrize("settings", MOTIONS.values(), ids=MOTIONS)
def test_forecasts(settings, dtype):
    tracker, state = boxes(TrackerConfig.model_validate(settings), dtype)
    for by_kernel, plain in zip(*map(stated, both_ways(forecasts(tracker, state))), strict=True):
        assert_as_close(by_kernel, plain, tolerance=TOLERANCE[dtype])


def test_what_would_be_lost_is_no_less_certain_than_before():
    tracker, state = boxes()
    state.motion.covariance[2] *= 1e8
    by_kernel, plain = both_ways(forecasts(tracker, state))
    assert torch.equal(by_kernel.covariance[2], state.motion.covariance[2])
    assert torch.equal(plain.covariance[2], state.motion.covariance[2])


@pytest.mark.parametrize("spoilt", ["not a number", "behind the camera", "much too far away"])
def test_a_forecast_that_is_of_no_use_is_told_and_disturbs_no_other(spoilt):
    tracker, state = boxes()
    expected = stated(forecasts(tracker, state)())
    state.T_cam_obj[3, 2, 3] = {"not a number": torch.nan, "behind the camera": -0.4, "much too far away": 1e6}[spoilt]
    with torch.inference_mode():
        scored = forecasts(tracker, state)()
    assert scored.usable.tolist() == [number != 3 for number in range(OBJECTS)]
    assert torch.equal(scored.T_cam_obj[3], tracker.far_pose[3])
    assert not scored.velocity[3].any()
    others = torch.arange(OBJECTS) != 3
    for ours, theirs in zip(stated(scored), expected, strict=True):
        assert_as_close(ours[others], theirs[others])


# ---- small matrices


def test_inverses_and_of_what_has_none_infinity():
    covariance = random_covariances()
    covariance[1, 3, 3] = -1.0
    by_kernels, plain = both_ways(lambda: inverse(covariance))
    scale = covariance.diagonal(dim1=1, dim2=2).abs().sqrt()
    relative = by_kernels * scale[:, None] * scale[..., None], plain * scale[:, None] * scale[..., None]
    assert torch.isinf(by_kernels[1].diagonal()).all()
    for number in (0, 2, 3):
        torch.testing.assert_close(relative[0][number], relative[1][number], rtol=1e-6, atol=1e-6)


# ---- the conclusion


def random_find(tracker, prediction, dtype):
    """A solution beside the prediction, and what is said for it: of some objects so little that they have failed."""
    # As likely as what is found.
    likely = torch.linalg.cholesky(prediction.covariance) @ torch.randn(OBJECTS, 12, 1, generator=generator(21), dtype=torch.float64)
    offset = likely[..., 0]
    T_cam_obj = retract_about(prediction.T_cam_obj.double(), offset[:, :6], tracker.centre_obj.double()).to(dtype)
    hessian = random_covariances(OBJECTS, seed=22) * 1e3 + 10 * torch.eye(12).double()
    contours = tracker.objects.contours(T_cam_obj, tracker.config.contours)
    count = torch.tensor([400, 300, 500, 3, 400, 600, 700])
    nothing = torch.zeros(OBJECTS, 50, dtype=dtype)
    pairs, exists = nothing[..., None].expand(-1, -1, 2), torch.ones_like(nothing, dtype=torch.bool)
    sides = uniform(OBJECTS, 50, 2, low=-1, seed=27).to(dtype)
    of_each = [uniform(OBJECTS, 50, low=low, seed=seed).to(dtype) for low, seed in ((0, 28), (-1, 29))]
    matches = MatchesWithCues(
        *(exists.long(), exists, of_each[0], nothing, nothing[..., None].expand(-1, -1, 3), pairs, sides, of_each[1]),
        *(exists, torch.ones_like(nothing), of_each[1].sign(), torch.ones_like(nothing)),
    )
    solution = Linearisation(T_cam_obj, offset.to(dtype), hessian.to(dtype), offset.to(dtype))
    measured, inlier_ratio = uniform(OBJECTS, low=0.3, seed=23).to(dtype), uniform(OBJECTS, seed=24).to(dtype)
    measured[0], measured[1], measured[5], inlier_ratio[2] = 0.05, 0.3, torch.nan, torch.nan
    elsewhere = torch.arange(OBJECTS) % 3 == 0
    reference_inlier_ratio, apart, agreement, required_spread = (uniform(OBJECTS, seed=seed).to(dtype) for seed in (26, 30, 32, 31))
    visible = visible_ratio(contours, tracker.objects.image_sizes).to(dtype)
    stated = measured, torch.ones_like(measured), count, inlier_ratio, reference_inlier_ratio, apart, agreement, visible, required_spread
    return ScoredFit(Fit(solution, contours, matches), *stated, elsewhere)


def conclusions(config, dtype, spoil=lambda scored: None):
    """What is concluded from a random find."""
    tracker, state = boxes(config, dtype)
    prediction = forecasts(tracker, state)()
    scored = random_find(tracker, prediction, dtype)
    spoil(scored)
    gate_scale = torch.tensor([1.0, 1.5, 3.0, 1.0, 1.0, 2.5, 1.2]).to(dtype)
    dt_s = uniform(OBJECTS, low=1e-3, high=2e-2, seed=11).to(dtype)
    return lambda: conclude(state, Relocalized(scored, prediction, gate_scale), no_corners(scored.fit.contours.pixels), dt_s, tracker.config)


CONCLUDED = {
    "as it is": {},
    "hold": {"motion": {"without_events": "hold"}},
    "nothing asked": {"validation": {"lost_below": 0.0, "uncertain_below": 0.0, "min_observations": 6, "max_rotation_rad": 9.0}},
    "much asked": {"validation": {"min_observations": 450, "max_translation": 0.3}},
    "no sides": {"disabled": ["polarity_prior"]},
}


@pytest.mark.parametrize("settings", CONCLUDED.values(), ids=CONCLUDED)
def test_conclusions(settings, dtype):
    (state, result), (other_state, other_result) = both_ways(conclusions(TrackerConfig.model_validate(settings), dtype))
    assert result.status.tolist() == other_result.status.tolist()
    assert len(set(result.status.tolist())) > 1
    assert_as_close((state, result), (other_state, other_result), tolerance=TOLERANCE[dtype])


@pytest.mark.parametrize("partly_hidden", [True, False])
def test_conclusions_of_what_may_be_partly_hidden(partly_hidden, dtype):
    def spoil(scored):
        scored.measured_ratio[:] = 0.2
        scored.reference_inlier_ratio[:] = torch.linspace(0.4, 0.9, OBJECTS)
        scored.inlier_ratio[:] = scored.reference_inlier_ratio * torch.tensor([1.0, 0.95, 0.9, 0.85, 1.0, 1.1, torch.nan])

    config = TrackerConfig(disabled=frozenset() if partly_hidden else {Component.PARTLY_HIDDEN})
    (state, result), (other_state, other_result) = both_ways(conclusions(config, dtype, spoil))
    assert_as_close((state, result), (other_state, other_result), tolerance=TOLERANCE[dtype])
    # Looked for in many places, it would be lost.
    assert int(result.status[5]) == (Status.UNCERTAIN if partly_hidden else Status.LOST)


@pytest.mark.parametrize("what", ["T_cam_obj", "hessian", "from_prior"])
def test_a_solution_that_is_not_a_number_stays_with_its_object(what):
    def spoil(scored):
        getattr(scored.fit.solution, what)[4] = torch.nan

    with torch.inference_mode():
        (state, result), (plain_state, plain) = conclusions(None, torch.float64, spoil)(), conclusions(None, torch.float64)()
    others = torch.arange(OBJECTS) != 4
    for ours, theirs in zip(tensors_of(result)[1:], tensors_of(plain)[1:], strict=True):
        assert_as_close(ours[others], theirs[others])
    assert torch.isfinite(state.motion.covariance).all()
    if what == "from_prior":
        assert result.status[4] == int(Status.DIVERGED)
    assert_as_close(state.health.reference_explained_ratio[others], plain_state.health.reference_explained_ratio[others])


def test_what_is_not_concluded_is_left_as_it_was():
    tracker, state = boxes()
    before = [tensor.clone() for tensor in tensors_of(state)]
    prediction = forecasts(tracker, state)()
    scored = random_find(tracker, prediction, torch.float64)
    dt_s = torch.full((OBJECTS,), 5e-3).double()
    with torch.inference_mode():
        located = Relocalized(scored, prediction, torch.ones_like(dt_s))
        conclude(state, located, no_corners(scored.fit.contours.pixels), dt_s, tracker.config)
    for ours, theirs in zip(tensors_of(state), before, strict=True):
        assert torch.equal(ours, theirs)
