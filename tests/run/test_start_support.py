"""Whether the first windows support the pose that a run starts from, and what is said of it."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from torchtrack.run.sinks.start_support import StartNotice, StartSupport
from torchtrack.run.stepping import Step
from torchtrack.tracking.validation.status import Status


class Judged(Step):
    """A step of which the judgement alone is known."""

    def __init__(self, status, quality):
        object.__setattr__(self, "result", SimpleNamespace(status=torch.tensor(status), quality=torch.tensor(quality)))


def steps(*windows):
    """Steps of one or more objects: for each window, statuses and qualities."""
    return [Judged(*window) for window in windows]


def lines_of(windows, **options):
    lines = []
    notice = StartNotice(["mug", "box"], lines.append, Path("out/first_window.png"), **options)
    for step in steps(*windows):
        notice.add(step)
    before = len(lines)
    notice.close()
    return lines, before


GOOD, BAD, SILENT = (Status.TRACKING, 0.8), (Status.UNCERTAIN, 0.3), (Status.TOO_FEW_EVENTS, 0.0)


def both(mug, box):
    return [mug[0], box[0]], [mug[1], box[1]]


@pytest.mark.parametrize(("windows", "supported"), [([GOOD] * 10, True), ([GOOD] * 4 + [BAD] * 6, False), ([BAD] * 5 + [GOOD] * 5, True)])
def test_most_of_the_first_windows_decide(windows, supported):
    support = StartSupport()
    for status, quality in windows[:-1]:
        support.add(status, quality)
    assert support.supported is None
    support.add(*windows[-1])
    assert support.supported is supported
    for _ in range(30):
        support.add(*(BAD if supported else GOOD))
    assert support.supported is supported
    assert support.explained_percent == pytest.approx(10 * sum(quality for _, quality in windows))


def test_windows_with_too_few_events_are_waited_out():
    support = StartSupport()
    for status, quality in [SILENT] * 50 + [GOOD] * 9:
        support.add(status, quality)
    assert support.supported is None
    support.add(*GOOD)
    assert support.supported


def test_each_object_is_told_of_once_as_soon_as_it_is_known():
    lines, before = lines_of([both(GOOD, BAD)] * 30)
    assert before == len(lines) == 2
    assert lines[0].startswith("mug: events support the initial pose (80 %")
    assert lines[1].startswith("box: events do NOT support the initial pose (30 %") and "out/first_window.png" in lines[1]


def test_where_only_doubts_are_told_a_supported_pose_is_not():
    lines, _ = lines_of([both(GOOD, BAD)] * 10, only_doubts=True)
    assert [line.split(":")[0] for line in lines] == ["box"]


def test_of_an_object_without_events_enough_nothing_is_told():
    lines, before = lines_of([both(GOOD, SILENT)] * 12)
    assert before == 1 and lines[0].startswith("mug")
