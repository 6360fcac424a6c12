"""How the parameters of a kernel are filled with settings and constants, by their names."""

from collections.abc import Callable
from functools import cache
from operator import attrgetter
from types import ModuleType
from typing import Any, TypeVar

T = TypeVar("T")
Getter = Callable[[Any], tuple[Any, ...]]


def filled(kind: type[T], *sources: Any, **more: Any) -> T:
    """Parameters of a kernel by the names of its fields: what is given, else an attribute of the first source that has one.

    Args:
        kind: a named tuple.
        sources: settings, or modules with constants, whose names are those of the fields in capitals.
        more: fields that no source has.
    """
    kinds: Any = kind
    getters, order = _plan(kinds, tuple([source if isinstance(source, ModuleType) else type(source) for source in sources]), tuple(more))
    values = [value for getter, source in zip(getters, sources, strict=True) for value in getter(source)]
    values += more.values()
    made: T = kinds._make([values[place] for place in order])
    return made


@cache
def _plan(kind: type[Any], sources: tuple[Any, ...], given: tuple[str, ...]) -> tuple[tuple[Getter, ...], tuple[int, ...]]:
    """What is read of each source, and where each field is among all that is read and what is given. Looked up once: settings are slow to say no."""
    places = {name: _place(name, sources) for name in kind._fields if name not in given}
    read = [[(name, spelled) for name, (number, spelled) in places.items() if number == source] for source in range(len(sources))]
    names = [name for of_source in read for name, _ in of_source] + list(given)
    return tuple(_getter([spelled for _, spelled in of_source]) for of_source in read), tuple(names.index(name) for name in kind._fields)


def _getter(names: list[str]) -> Getter:
    """Reads attributes as a tuple, also where there is one or none."""
    if len(names) > 1:
        return attrgetter(*names)
    return lambda source: tuple(getattr(source, name) for name in names)


def _place(name: str, sources: tuple[Any, ...]) -> tuple[int, str]:
    for number, source in enumerate(sources):
        known = source.model_fields if hasattr(source, "model_fields") else vars(source)
        for spelled in (name, name.upper()):
            if spelled in known:
                return number, spelled
    raise AttributeError(f"no source has '{name}'")
