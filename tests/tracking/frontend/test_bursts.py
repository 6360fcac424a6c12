"""Bursts: when the newest one of each pixel and polarity began."""

import pytest
import torch
from helpers import generator

from torchtrack.core.events import EventBatch, PaddedEvents, concatenate, pad_streams
from torchtrack.tracking.frontend.bursts import LONG_AGO_US, LONGEST_US, no_bursts, update_bursts


def batch(*events, stream=0):
    """Events ``(t_us, x, y, polarity)``."""
    t, x, y, p = (torch.tensor(column, dtype=torch.int64) for column in zip(*events, strict=True))
    return EventBatch(x.int(), y.int(), t, p.bool(), torch.full_like(t, stream))


def update(ages, events, elapsed_us, end_us):
    streams = len(ages)
    ends = torch.full((streams,), end_us)
    return update_bursts(ages, torch.full((streams,), elapsed_us), pad_streams(events, streams, ends))


def test_events_of_a_pixel_and_polarity_are_one_burst():
    ages = update(no_bursts(1, 4, 6), batch((1000, 2, 1, 1), (1500, 2, 1, 1), (3000, 2, 1, 1), (3500, 3, 1, 1), (4000, 2, 1, 0)), 5000, 5000)
    assert int(ages[0, 1, 1, 2]) == 4000
    assert int(ages[0, 1, 1, 3]) == 1500
    assert int(ages[0, 0, 1, 2]) == 1000


def test_a_burst_goes_on_from_window_to_window():
    ages = update(no_bursts(1, 4, 6), batch((1000, 2, 1, 1)), 5000, 5000)
    ages = update(ages, batch((6000, 2, 1, 1)), 5000, 10_000)
    assert int(ages[0, 1, 1, 2]) == 9000


def test_after_its_longest_time_the_next_event_begins_another():
    ages = update(no_bursts(1, 4, 6), batch((1000, 2, 1, 1)), 5000, 5000)
    ages = update(ages, EventBatch.empty(), 5000, 10_000)
    # The first is 9.9 ms into the old burst; the second begins a new one.
    ages = update(ages, batch((10_900, 2, 1, 1), (11_000, 2, 1, 1), (12_000, 2, 1, 1)), 5000, 15_000)
    assert int(ages[0, 1, 1, 2]) == 4000


@pytest.mark.parametrize("windows", [1, 2, 5])
def test_bursts_are_those_of_the_events_one_by_one(windows):
    make, count, length_us = generator(3), 3000, 40_000
    t = torch.randint(1, length_us, (count,), generator=make).sort().values
    x, y, p = (torch.randint(0, high, (count,), generator=make) for high in (6, 4, 2))
    start, ages, step = {}, no_bursts(1, 4, 6), length_us // windows // 8
    for end in range(step, length_us + step, step):
        inside = (t > end - step) & (t <= end)
        events = [column[inside].tolist() for column in (t, x, y, p)]
        for now, *pixel in zip(*events, strict=True):
            if now - start.get(tuple(pixel), -(10**9)) >= LONGEST_US:
                start[tuple(pixel)] = now
        ages = update(ages, batch(*zip(*events, strict=True)), step, end)
        for (column, row, polarity), began in start.items():
            assert int(ages[0, polarity, row, column]) == min(end - began, LONG_AGO_US)


def test_streams_are_apart_and_padding_is_no_event():
    events = concatenate([batch((1000, 0, 0, 0), (2000, 0, 0, 0)), batch((3000, 0, 0, 0), stream=1)])
    ages = update(no_bursts(2, 2, 2), events, 5000, 5000)
    assert ages[:, 0, 0, 0].tolist() == [4000, 2000]
    assert (ages.flatten(1)[:, 1:] == LONG_AGO_US).all()


def test_the_old_map_is_left_as_it_was_and_ages_do_not_overflow():
    before = no_bursts(1, 2, 2)
    ages = update(before, batch((1000, 0, 0, 0)), 5000, 5000)
    assert (before == LONG_AGO_US).all()
    for elapsed_us in (5000, 30_000, 10_000_000):
        ages = update(ages, EventBatch.empty(), elapsed_us, elapsed_us)
        assert (ages > 0).all() and (ages <= LONG_AGO_US).all()
    assert (ages == LONG_AGO_US).all()


def test_of_a_window_longer_than_ages_are_kept_ages_are_still_numbers():
    ages = update(no_bursts(1, 2, 2), batch((1000, 0, 0, 0), (990_000, 0, 0, 0)), 1_000_000, 1_000_000)
    assert (ages >= 0).all() and (ages <= LONG_AGO_US).all()


def test_of_several_bursts_in_a_window_the_first_is_kept():
    ages = update(no_bursts(1, 2, 2), batch((1000, 0, 0, 0), (3000, 0, 0, 0), (15_000, 0, 0, 0), (16_000, 0, 0, 0)), 20_000, 20_000)
    assert int(ages[0, 0, 0, 0]) == 19_000


def test_padded_events_of_nothing():
    nothing = torch.zeros(1, 1, dtype=torch.int64)
    none = PaddedEvents(nothing, nothing, nothing, nothing.bool(), nothing.bool())
    assert (update_bursts(no_bursts(1, 2, 2), torch.tensor([5000]), none) == LONG_AGO_US).all()
