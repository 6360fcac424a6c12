"""Searches that go on beside the windows, in a thread of their own: a window takes as long whether objects are lost or not.

A search starts from what a window has computed, and its answer comes ``relocalization.answer_after_us`` later. What was found is followed through
the windows since, alone, as they come, so that its pose is one of now. When the answer comes does not hang on how long it took: poses are the same
on any machine, and a search that takes longer is waited for. There is one search at a time, of one kind; other kinds, and what objects ask for
meanwhile, have their turn next.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.core.events import EventBatch
from torchtrack.core.later import Ahead
from torchtrack.tracking.state import Answer, Search, StepResult, TrackerState, put_object
from torchtrack.tracking.step import StepInput
from torchtrack.tracking.validation.status import Status
from torchtrack.tracking.validation.verdict import Limits

Taken = tuple[TrackerState, StepResult]
Follow = Callable[[int, TrackerState, EventBatch, Tensor], Taken]
"""A window of an object alone: its number, the state of it alone, all events, and the window's end."""


def may_search_later(state: TrackerState, config: TrackerConfig) -> bool:
    """Whether searches are not waited for: on a GPU, and where gradients are recorded, they always are."""
    return bool(config.relocalization.answer_after_us) and host_sync.read_at_once(state.t_us) and not torch.is_grad_enabled()


def followed(search: Search, window: StepInput, follow: Follow, ahead: Ahead) -> Search:
    """The search with what it finds followed through one more window."""
    if search.answer is None:
        return search
    answer = search.answer.then(partial(_followed, window=window, follow=follow))
    ahead.compute(answer)
    return replace(search, answer=answer)


@torch.no_grad()
def _followed(answer: Answer, window: StepInput, follow: Follow) -> Answer:
    relocalized = {number: follow(number, state, window.events.events, window.t_us) for number, (state, _) in answer.relocalized.items()}
    return replace(answer, relocalized=relocalized)


def with_search(taken: Taken, under_way: Search | None, config: TrackerConfig, ahead: Ahead) -> Taken:
    """State and result of a window with the search that goes on after it, and with the answer of one that is due.

    Args:
        taken: with the search that the window asks for, if any.
        under_way: the one that went on before the window, followed through it.
        config: of the tracker.
        ahead: the thread that searches.
    """
    state, result = taken
    asked = state.search
    if under_way is None or under_way.answer is None:
        if asked is None or asked.answer is None:
            return taken
        ahead.compute(asked.answer)
        return replace(state, search=replace(asked, triggers=asked.triggers & ~asked.kind)), result
    left = replace(under_way, triggers=torch.zeros_like(under_way.triggers) if asked is None else asked.triggers)
    if int((state.t_us - under_way.since_us).max()) < config.relocalization.answer_after_us:
        return replace(state, search=left), result
    state, result = answered((state, result), under_way.answer.value(), Limits.from_config(config))
    return replace(state, search=replace(left, answer=None) if bool(left.triggers.any()) else None), result


def answered(taken: Taken, answer: Answer, limits: Limits) -> Taken:
    """State and result of a window with what a search has found, where that explains more by now than what the object has become meanwhile."""
    state, result = taken
    state = replace(state, health=state.health.after_looks(answer.looked, answer.is_unconfirmed, limits))
    for number, own in answer.relocalized.items():
        if _is_better(number, own, (state, result)):
            state, result = put_object(number, (state, result), own)
    return state, result


def _is_better(number: int, own: Taken, taken: Taken) -> bool:
    is_lost, was_lost = (int(status) >= int(Status.LOST) for status in (own[1].status[0], taken[1].status[number]))
    return not is_lost and (was_lost or float(own[0].health.score[0]) > float(taken[0].health.score[number]))
