"""Poses that the polarity of events on texture speaks against: when it does, and that these are not confirmed."""

from dataclasses import replace

import pytest
import torch
from helpers import upright_line
from measured_matches import matches_at
from tracked_boxes import in_motion

from torchtrack.config.tracker import TrackerConfig
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.validation.health import TrackHealth
from torchtrack.tracking.validation.texture_polarity import AGREES_FROM, contradicts, without_contradicted
from torchtrack.tracking.validation.verdict import Limits

LIMITS = Limits.from_config(TrackerConfig())
MANY = LIMITS.min_observations


def seen_on(agreement, *, count=MANY, kind=ContourKind.TEXTURE, offsets=0.0):
    """Observations on contours of one kind, which agree so far with what is expected of them."""
    matches = matches_at(torch.full((1, count, 2), 80.0), offsets=offsets)
    return upright_line(80.0, kind=kind), replace(matches, as_expected=torch.full_like(matches.weights, agreement))


@pytest.mark.parametrize(("agreement", "expected"), [(1.0, False), (AGREES_FROM + 0.01, False), (AGREES_FROM - 0.01, True), (0.05, True)])
def test_events_that_agree_too_little_speak_against_a_pose(agreement, expected):
    assert contradicts(*seen_on(agreement), LIMITS).tolist() == [expected]


@pytest.mark.parametrize("other", [{"count": MANY - 1}, {"kind": ContourKind.CREASE}, {"kind": ContourKind.LEARNED}, {"offsets": 2.0}])
def test_too_few_of_them_on_texture_say_nothing(other):
    assert contradicts(*seen_on(0.1, **other), LIMITS).tolist() == [False]


def test_what_agrees_elsewhere_makes_up_for_nothing():
    """Half of the observations are on texture, and agree badly; the others are on a crease, and agree well."""
    contours, matches = seen_on(1.0, count=2 * MANY)
    contours = replace(contours, kind=contours.kind.index_fill(1, torch.tensor([1]), int(ContourKind.CREASE)))
    half = (torch.arange(2 * MANY) % 2)[None]
    matches = replace(matches, contour=half, as_expected=torch.where(half == 1, 1.0, 0.5).double())
    assert contradicts(contours, matches, LIMITS).tolist() == [True]


def after(confirmations, agreement, *, is_relocalized=False):
    """Confirmations after a window that stands on such observations."""
    health = replace(TrackHealth.unknown(torch.eye(4)[None].double(), torch.float32), confirmations=torch.tensor([confirmations]))
    contours, matches = seen_on(agreement)
    scored = in_motion()[3]
    scored = replace(scored, fit=replace(scored.fit, contours=contours, matches=matches), is_relocalized=torch.tensor([is_relocalized]))
    return without_contradicted(health, scored, LIMITS).confirmations.tolist()


@pytest.mark.parametrize("confirmations", [1.0, 3.0])
def test_a_pose_that_texture_contradicts_is_confirmed_anew(confirmations):
    assert after(confirmations, 0.5) == [0.0]
    assert after(confirmations, 0.95) == [confirmations]


def test_what_is_confirmed_stays_so_and_what_was_relocalized_stands_on_other_matches():
    assert after(4.0, 0.5) == [4.0]
    assert after(2.0, 0.5, is_relocalized=True) == [2.0]
