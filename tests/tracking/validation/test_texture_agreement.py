"""What the polarity of events on texture says of a pose: how far they agree on its darker side."""

from dataclasses import replace

import pytest
import torch
from helpers import upright_line
from measured_matches import matches_at

from torchtrack.config.validation import ValidationConfig
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.validation.measures import texture_agreement

SETTINGS = ValidationConfig()
MANY = SETTINGS.min_observations


def seen_on(agreement, *, count=MANY, kind=ContourKind.TEXTURE, offsets=0.0):
    """Observations on contours of one kind, which agree so far with what is expected of them."""
    matches = matches_at(torch.full((1, count, 2), 80.0), offsets=offsets)
    return upright_line(80.0, kind=kind), replace(matches, as_expected=torch.full_like(matches.weights, agreement))


def test_it_is_the_mean_over_observations_on_texture():
    assert texture_agreement(*seen_on(0.7), SETTINGS).tolist() == pytest.approx([0.7])


@pytest.mark.parametrize("other", [{"count": MANY - 1}, {"offsets": 2.0}])
def test_too_few_of_them_say_nothing(other):
    assert texture_agreement(*seen_on(0.1, **other), SETTINGS).isnan().all()


@pytest.mark.parametrize("kind", sorted(set(ContourKind) - {ContourKind.TEXTURE}))
def test_those_on_other_contours_say_nothing(kind):
    assert texture_agreement(*seen_on(0.1, kind=kind), SETTINGS).isnan().all()


@pytest.mark.parametrize("resolved", [1.0, 0.5, 0.2])
def test_the_less_an_edge_is_resolved_the_less_is_asked_of_its_events(resolved):
    """Where half of what they say is chance, three quarters that agree are as good as all where nothing is."""
    contours, matches = seen_on(0.5 + 0.5 * resolved, count=int(MANY / resolved**2) + 1)
    fine = replace(contours, resolved=torch.full_like(contours.resolved, resolved))
    assert texture_agreement(fine, matches, SETTINGS).tolist() == pytest.approx([1.0])
    # So they tell less.
    few = seen_on(0.5 + 0.5 * resolved, count=int(MANY / resolved**2) - 1)[1]
    assert texture_agreement(fine, few, SETTINGS).isnan().all()


def test_what_is_not_resolved_at_all_says_nothing():
    contours, matches = seen_on(0.1, count=100 * MANY)
    assert texture_agreement(replace(contours, resolved=torch.zeros_like(contours.resolved)), matches, SETTINGS).isnan().all()


def test_what_agrees_elsewhere_makes_up_for_nothing():
    """Half of the observations are on texture, and agree badly; the others are on a crease, and agree well."""
    contours, matches = seen_on(1.0, count=2 * MANY)
    contours = replace(contours, kind=contours.kind.index_fill(1, torch.tensor([1]), int(ContourKind.CREASE)))
    half = (torch.arange(2 * MANY) % 2)[None]
    matches = replace(matches, contour=half, as_expected=torch.where(half == 1, 1.0, 0.5).double())
    assert texture_agreement(contours, matches, SETTINGS).tolist() == pytest.approx([0.5])


def test_an_object_of_which_something_is_not_a_number_leaves_its_neighbours_as_they_are():
    contours, matches = seen_on(0.7)
    both = replace(contours, **{name: torch.cat([value, value]) for name, value in vars(contours).items()})
    twice = replace(matches, **{name: torch.cat([value, value]) for name, value in vars(matches).items()})
    spoilt = replace(twice, as_expected=twice.as_expected.index_fill(0, torch.tensor([1]), torch.nan))
    assert texture_agreement(both, spoilt, SETTINGS)[0] == texture_agreement(contours, matches, SETTINGS)[0]
