"""Values that are computed once, by whoever asks first: here, in another thread, or in a copy."""

import copy
import pickle
import threading
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar

import pytest

from torchtrack.core.later import Ahead, Later

NAME = ContextVar("name of the context", default="none")


def constant():
    return 1


def counted():
    """A value that tells how often it was computed, and the list of when."""
    calls = []
    return Later(lambda: calls.append(threading.get_ident()) or len(calls)), calls


def test_a_value_is_computed_once_and_not_before_it_is_asked_for():
    later, calls = counted()
    assert not calls
    assert [later.value(), later.value()] == [1, 1]
    assert calls == [threading.get_ident()]


def test_many_threads_that_ask_at_once_get_the_same():
    later, calls = counted()
    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(lambda _: later.value(), range(64))) == {1}
    assert len(calls) == 1


def test_many_that_are_made_of_one_another_are_computed_one_after_the_other():
    later = Later(lambda: 0)
    for _ in range(5000):
        later = later.then(lambda value: value + 1)
    assert later.value() == 5000


def test_those_made_of_one_that_fails_fail():
    later = Later(lambda: 1 // 0).then(lambda value: value + 1)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            later.value()


def test_it_is_computed_in_the_context_that_it_was_made_in():
    token = NAME.set("there")
    later = Later(NAME.get)
    NAME.reset(token)
    assert later.value() == "there"


def test_an_error_is_raised_wherever_the_value_is_asked_for():
    later = Later(lambda: 1 // 0)
    Ahead().compute(later)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            later.value()


def test_ahead_computes_in_a_thread_of_its_own_and_in_order():
    ahead, begin, ended, order = Ahead(), threading.Event(), threading.Event(), []
    ahead.compute(Later(lambda: begin.wait(10) and order.append((1, threading.get_ident()))))
    ahead.compute(Later(lambda: order.append((2, threading.get_ident())) or ended.set()))
    assert not order
    begin.set()
    assert ended.wait(10)
    (first, its_thread), (second, other_thread) = order
    assert (first, second) == (1, 2) and its_thread == other_thread != threading.get_ident()


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))], ids=["copy", "deepcopy", "pickle"])
def test_copies_have_the_value_and_threads_of_their_own(copied):
    assert copied(Later(constant)).value() == 1
    ahead, later = Ahead(), Later(constant)
    ahead.compute(later)
    other, another = copied(ahead), Later(constant)
    other.compute(another)
    assert later.value() == another.value() == 1
