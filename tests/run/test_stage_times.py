"""Stages that are timed from outside: their own times, and all as it was afterwards."""

import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from tracked_boxes import started

from torchtrack.config.tracker import AssociationConfig, CornerConfig, TrackerConfig
from torchtrack.run.stage_times import STAGES, StageTimes, owner_of, stages_timed, timed
from torchtrack.run.stepping import timed_step

# Corners and their flow are stages, too.
ALONG_FLOW = TrackerConfig(corners=CornerConfig(max_corners=32), association=AssociationConfig(search="along_flow"))
PLACES = [place for places in STAGES.values() for place in places]


def ticks():
    """A clock that goes on by one at every look."""
    looks = iter(range(1000))
    return lambda: float(next(looks))


def functions():
    return [getattr(*owner_of(place)) for place in PLACES]


def test_afterwards_all_is_as_it_was():
    before = functions()
    with timed(StageTimes(time.perf_counter)):
        assert all(now is not then for now, then in zip(functions(), before, strict=True))
    assert all(now is then for now, then in zip(functions(), before, strict=True))


def test_afterwards_all_is_as_it_was_after_an_error_too():
    before = functions()
    with pytest.raises(KeyError), timed(StageTimes(time.perf_counter)):
        raise KeyError
    assert all(now is then for now, then in zip(functions(), before, strict=True))


def test_a_stage_counts_its_own_time_alone():
    times = StageTimes(ticks())
    inner = times.timing("inner", lambda value: value + 1)
    outer = times.timing("outer", lambda value: inner(inner(value)))
    assert outer(1) == 3
    # Looks at the clock: outer begins at 0, inner at 1 and 3, and outer ends at 5.
    assert dict(times.seconds) == {"inner": 2.0, "outer": 3.0}


def test_a_stage_that_fails_is_counted_too():
    def fails():
        raise KeyError

    times = StageTimes(ticks())
    with pytest.raises(KeyError):
        times.timing("fails", fails)()
    assert dict(times.seconds) == {"fails": 1.0}


def test_what_another_thread_does_meanwhile_is_no_part_of_a_stage():
    times = StageTimes(ticks())
    inner = times.timing("inner", lambda value: value + 1)
    with ThreadPoolExecutor(1) as pool:
        outer = times.timing("outer", lambda value: pool.submit(inner, value).result())
        assert outer(1) == 2
    assert dict(times.seconds) == {"outer": 1.0}


def test_every_stage_of_a_step_is_timed_and_the_step_is_the_same():
    with torch.no_grad():
        tracker, state, _, (events, end_us), _ = started(config=ALONG_FLOW)
    expected = tracker.step(state, events, end_us)[1]
    times = StageTimes(time.perf_counter)
    with timed(times):
        result = tracker.step(state, events, end_us)[1]
        with torch.inference_mode():
            # Where kernels are used, unlike above.
            tracker.step(state, events, end_us)
    assert torch.equal(result.T_cam_obj, expected.T_cam_obj)
    assert set(times.seconds) == set(STAGES)
    assert all(value > 0 for value in times.seconds.values())


def test_a_step_says_how_long_its_stages_took_where_that_is_asked_for():
    tracker, state, _, (events, end_us), _ = started()
    with stages_timed(torch.device("cpu")):
        taken = timed_step(tracker, state, events, end_us)[2]
    assert {"prediction", "rounds", "conclusion", "rest"} <= set(taken.stages) <= set(STAGES)
    # Each second is of one stage.
    assert sum(taken.stages.values()) <= taken.seconds
    assert taken.part(4).stages["rest"] == taken.stages["rest"] / 4


def test_nothing_is_timed_where_nobody_asks():
    before = functions()
    tracker, state, _, (events, end_us), _ = started()
    with stages_timed(torch.device("cpu")):
        pass
    assert timed_step(tracker, state, events, end_us)[2].stages == {}
    assert all(now is then for now, then in zip(functions(), before, strict=True))
