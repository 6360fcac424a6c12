"""Observations: which events near the contours are taken, how many, how evenly, and how steadily."""

import pytest
import torch
from helpers import IMAGE_SIZE, contours_at, generator, moving_objects, seen, upright_line

from torchtrack.tracking.association.observations import join, select_events
from torchtrack.tracking.contours.index import index_contours
from torchtrack.tracking.frontend.window_events import WindowEvents

# Events of a window, and those near a contour among them.
EVENTS, NEAR = 6000, 4000


def numbered(near, count):
    """Numbers of the events taken of ``near [b, e]``: one set per object."""
    number = torch.arange(near.shape[1], dtype=torch.float64).expand(near.shape)
    pixels = torch.stack([torch.where(near, 80.0, 10.0), torch.full_like(number, 60.0)], -1)
    lines = contours_at(upright_line(80.0).pixels.expand(len(near), -1, -1))
    index = index_contours(lines, IMAGE_SIZE, 5, 1)
    events = WindowEvents(pixels, number, torch.ones_like(number), torch.ones_like(near))
    chosen = select_events(events, index, moving_objects((0.0, 0.0), len(near)), count)
    assert chosen.pixels.shape == (len(near), count, 2)
    return [row[mask].long().tolist() for row, mask in zip(chosen.age_s, chosen.mask, strict=True)]


def random_near(seed=0, total=NEAR):
    near = torch.zeros(1, EVENTS, dtype=torch.bool)
    near[0, torch.randperm(EVENTS, generator=generator(seed))[:total]] = True
    return near


# ---- events near contours


def choose(pixels, contours, *, age_s=0.0, velocity=(0.0, 0.0), count=100, mask=None):
    observations = seen(pixels, age_s=age_s, mask=mask, polarity=1.0)
    index = index_contours(contours, IMAGE_SIZE, 5, 1)
    events = WindowEvents(observations.pixels, observations.age_s, observations.polarity, observations.mask)
    return select_events(events, index, moving_objects(velocity, len(observations.pixels)), count)


def test_events_near_a_contour_are_taken_and_others_left():
    chosen = choose([[[80.0, 60.0], [84.0, 60.0], [95.0, 60.0], [78.0, 60.0], [79.0, 60.0]]], upright_line(80.0), mask=[[True] * 4 + [False]])
    assert chosen.pixels[chosen.mask].tolist() == [[80, 60], [84, 60], [78, 60]]
    assert chosen.polarity[chosen.mask].tolist() == [1, 1, 1]
    assert not chosen.has_flow.any()


def test_events_are_judged_where_they_are_at_the_end_of_the_window():
    chosen = choose([[[60.0, 60.0], [80.0, 60.0]]], upright_line(80.0), age_s=0.02, velocity=(1000.0, 0.0))
    assert chosen.pixels[chosen.mask].tolist() == [[60, 60]]
    assert chosen.age_s[chosen.mask].tolist() == [0.02]


@pytest.mark.parametrize("count", [90, 300, 1200])
@pytest.mark.parametrize("seed", range(3))
def test_nearly_as_many_events_are_taken_as_asked_for_and_never_more(count, seed):
    (chosen,) = numbered(random_near(seed), count)
    assert 0.85 * count <= len(chosen) <= count
    assert len(set(chosen)) == len(chosen)
    assert chosen == sorted(chosen)


@pytest.mark.parametrize("total", [0, 1, 299, 300])
def test_where_there_are_few_all_are_taken(total):
    near = random_near(total=total)
    (chosen,) = numbered(near, 300)
    assert chosen == near[0].nonzero()[:, 0].tolist()


def test_the_events_of_an_even_stream_are_spread_evenly():
    """Multiples of the golden ratio leave gaps of three lengths at most, which are neighbouring Fibonacci numbers."""
    (chosen,) = numbered(torch.ones(1, 900, dtype=torch.bool), 90)
    assert 80 <= len(chosen) <= 90
    gaps = torch.diff(torch.tensor(chosen)).double()
    assert gaps.unique().tolist() == [5, 8, 13]
    assert chosen[0] < 2 * float(gaps.mean())
    assert chosen[-1] > 899 - 2 * float(gaps.mean())


@pytest.mark.parametrize("seed", range(3))
def test_the_events_taken_are_spread_in_time_as_those_near_a_contour_are(seed):
    near = random_near(seed)
    (chosen,) = numbered(near, 600)
    taken = torch.zeros(EVENTS).index_fill(0, torch.tensor(chosen), 1.0)
    shares = taken.view(10, -1).sum(1) / near[0].view(10, -1).sum(1)
    assert float(shares.min()) > 0.7 * float(shares.mean())
    assert float(shares.max()) < 1.3 * float(shares.mean())


@pytest.mark.parametrize("count", [300, 1200])
def test_an_event_more_or_less_changes_few_choices(count):
    """Else the smallest difference between poses would become another set of events, and grow."""
    near = random_near()
    (before,) = numbered(near, count)
    changed = []
    for removed in near[0].nonzero()[::97, 0].tolist():
        without = near.clone()
        without[0, removed] = False
        (after,) = numbered(without, count)
        assert removed not in after
        changed.append(len(set(before) ^ set(after)))
    assert len(changed) > 40
    assert max(changed) <= 0.02 * count
    assert sum(changed) / len(changed) < 2


def test_events_far_from_the_contours_change_no_choice():
    near = random_near()
    (before,) = numbered(near, 600)
    more = torch.cat([near, torch.zeros(1, 2000, dtype=torch.bool)], 1)
    assert numbered(more, 600)[0] == before


def test_the_choice_of_an_object_does_not_depend_on_the_others():
    near = torch.cat([random_near(0), random_near(1, 500), random_near(2, 0)])
    together = numbered(near, 600)
    assert together == [numbered(near[number : number + 1], 600)[0] for number in range(3)]


def test_values_go_with_their_events(dtype):
    place = torch.stack([torch.full((400,), 80.0, dtype=dtype), torch.linspace(20, 119, 400, dtype=dtype)], -1)[None]
    age_s, polarity = torch.linspace(0, 5e-3, 400, dtype=dtype)[None], torch.where(torch.arange(400) % 2 == 0, 1, -1).to(dtype)[None]
    index = index_contours(upright_line(80.0, dtype), IMAGE_SIZE, 5, 1)
    events = WindowEvents(place, age_s, polarity, torch.ones(1, 400, dtype=torch.bool))
    chosen = select_events(events, index, moving_objects((0.0, 0.0), dtype=dtype), 50)
    number = ((chosen.pixels[0, :, 1] - 20) / 99 * 399).round().long()[chosen.mask[0]]
    assert len(number) > 40
    pairs = ((chosen.pixels, place), (chosen.age_s, age_s), (chosen.polarity, polarity))
    for actual, given in pairs:
        assert torch.equal(actual[0][chosen.mask[0]], given[0][number])
    assert chosen.pixels.dtype == chosen.flow.dtype == dtype
    assert not chosen.has_flow.any()


# ---- both


def with_corners(corners, near, count):
    """Corners, and events near a contour, whose ages are their numbers."""
    number = torch.arange(near, dtype=torch.float64)[None]
    pixels = torch.stack([torch.full_like(number, 80.0), torch.full_like(number, 60.0)], -1)
    events = WindowEvents(pixels, number, torch.ones_like(number), torch.ones_like(number, dtype=torch.bool))
    return select_events(events, index_contours(upright_line(80.0), IMAGE_SIZE, 5, 1), moving_objects((0.0, 0.0)), count, corners)


def some_corners(places, missing):
    place = torch.arange(places, dtype=torch.float64)
    mask = torch.tensor([[number not in missing for number in range(places)]])
    flow = torch.where(mask[..., None], torch.tensor([3.0, 4.0], dtype=torch.float64), 0)
    return seen(torch.stack([place, -place], -1)[None], age_s=-1.0, polarity=-1.0, flow=flow, mask=mask)


def test_corners_stay_in_their_places_and_events_take_those_that_they_leave():
    corners = some_corners(6, missing=(1, 4, 5))
    both = with_corners(corners, near=4, count=7)
    assert both.mask.tolist() == [[True] * 7]
    assert both.age_s.tolist() == [[-1, 0, -1, -1, 1, 2, 3]]
    assert both.polarity.tolist() == [[-1, 1, -1, -1, 1, 1, 1]]
    assert both.has_flow.tolist() == [[True, False, True, True, False, False, False]]
    own = corners.mask[0]
    for name in ("pixels", "flow"):
        assert torch.equal(getattr(both, name)[0, :6][own], getattr(corners, name)[0][own])
    assert (both.flow[~both.has_flow] == 0).all()


@pytest.mark.parametrize(("places", "missing", "expected"), [(20, 8, 88), (20, 20, 100), (100, 0, 0), (120, 0, 0), (120, 60, 40)])
def test_events_make_up_for_corners_that_are_few(places, missing, expected):
    corners = some_corners(places, missing=range(missing))
    both = with_corners(corners, near=100, count=100)
    assert both.mask.shape == (1, max(places, 100))
    events = both.age_s[0][both.mask[0] & (both.age_s[0] >= 0)].tolist()
    # Lots fall evenly, but for a few.
    assert abs(len(events) - expected) <= 3
    assert events == sorted(events)
    # They are spread over all that there are.
    assert expected == 0 or events[-1] >= 95
    assert int(both.mask.sum()) == places - missing + len(events)


def test_joined_observations_are_those_of_both():
    both = join(seen([[[1.0, 2.0]]], age_s=0.1, flow=[3.0, 4.0]), seen([[[5.0, 6.0], [7.0, 8.0]]], polarity=-1.0, mask=[[True, False]]))
    assert both.pixels.tolist() == [[[1, 2], [5, 6], [7, 8]]]
    assert both.age_s.tolist() == [[0.1, 0, 0]]
    assert both.polarity.tolist() == [[0, -1, -1]]
    assert both.mask.tolist() == [[True, True, False]]
    assert both.has_flow.tolist() == [[True, False, False]]


def test_what_is_drawn_hangs_on_an_events_own_number_also_where_others_were_left_out():
    near = torch.rand((1, 4000), generator=generator(7)) < 0.5
    numbers = torch.arange(4000.0)[None]
    left = (near | (torch.rand(near.shape, generator=generator(8)) < 0.3))[0].nonzero()[:, 0]
    all_of_them = WindowEvents(torch.stack([numbers, numbers], -1), numbers, numbers, torch.ones_like(near))
    some = WindowEvents(*(getattr(all_of_them, name)[:, left] for name in ("pixels", "age_s", "polarity", "mask")), left[None])
    share = torch.tensor([[0.1]])
    chosen, exists = all_of_them.draw(near, share, 300)
    of_some, some_exist = some.draw(near[:, left], share, 300)
    assert 100 < int(exists.sum()) < 300
    assert torch.equal(exists, some_exist)
    assert torch.equal(chosen[exists], left[of_some[some_exist]])


# ---- the events of one object


def test_each_object_can_have_events_of_its_own():
    values = [torch.rand((2, 9, *shape), generator=generator(k)) for k, shape in enumerate([(2,), (), ()])]
    mask = torch.ones(2, 9, dtype=torch.bool)
    mask[1, 5] = False
    chosen, exists = torch.tensor([[1, 4, 0], [2, 5, 8]]), torch.tensor([[True, True, False], [True, True, True]])
    own = WindowEvents(*values, mask).only(chosen, exists)
    assert own.mask.tolist() == [[True, True, False], [True, False, True]]
    assert torch.equal(own.number, chosen)
    for name, value in zip(("pixels", "age_s", "polarity"), values, strict=True):
        assert torch.equal(getattr(own, name), torch.stack([value[number, chosen[number]] for number in range(2)]))
    again = own.only(torch.tensor([[1], [2]]), torch.ones(2, 1, dtype=torch.bool))
    assert again.number.tolist() == [[4], [8]]


def test_the_events_of_one_object_can_be_repeated():
    values = [torch.rand((3, 5, *shape), generator=generator(k)) for k, shape in enumerate([(2,), (), ()])]
    events = WindowEvents(*values, torch.rand((3, 5), generator=generator(4)) < 0.5)
    repeated = events.of_object(1).repeated(4)
    for name in ("pixels", "age_s", "polarity", "mask"):
        value = getattr(events, name)
        many = getattr(repeated, name)
        assert many.shape == (4, *value.shape[1:])
        assert all(torch.equal(row, value[1]) for row in many)
        # Nothing is copied.
        assert many.data_ptr() == value[1].data_ptr()
