"""What is computed when it is first asked for, and kept."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class _Once(Generic[T]):
    """A method as an attribute, computed once: the library's ``cached_property`` without its lock, which no compiled graph can hold."""

    def __init__(self, compute: Callable[[Any], T]) -> None:
        self._compute = compute
        self.__doc__ = compute.__doc__

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: Any, owner: type) -> T:
        value = self._compute(instance)
        # From now on it is found there first.
        instance.__dict__[self._name] = value
        return value


once = _Once
