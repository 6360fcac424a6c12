"""Validation errors as a message that a person can act on."""

import difflib
from collections.abc import Collection, Iterator
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from torchtrack.config.renamed import no_setting, renamed

Location = tuple[int | str, ...]
# What was got may be a whole file in the wrong place.
_MOST_SHOWN, _LONGEST_SHOWN = 50, 200


def explained(error: ValidationError, settings: type[BaseModel], file: str | None, from_command_line: Collection[str] = ()) -> str:
    """All mistakes, one a line: dotted key, what is wrong, what was got, and what was perhaps meant."""
    mistakes = error.errors()
    shown = [_line(details, settings, from_command_line) for details in mistakes[:_MOST_SHOWN]]
    count = "1 setting is wrong" if len(mistakes) == 1 else f"{len(mistakes)} settings are wrong"
    more = [f"and {len(mistakes) - len(shown)} more"] if len(mistakes) > len(shown) else []
    return f"{file or 'command line'}: {count}\n" + "\n".join(f"  {line}" for line in (*shown, *more))


def _line(details: ErrorDetails, settings: type[BaseModel], from_command_line: Collection[str]) -> str:
    key = ".".join(str(part)[:_LONGEST_SHOWN] for part in details["loc"])
    origin = " (command line)" if any(key == typed or key.startswith(f"{typed}.") for typed in from_command_line) else ""
    return f"{key}{origin}: {_reason(details, settings)}" if key else _reason(details, settings)


def _reason(details: ErrorDetails, settings: type[BaseModel]) -> str:
    if details["type"] == "extra_forbidden":
        if now := renamed(details["loc"], details["input"]):
            return f"renamed to {now}"
        if what := no_setting(details["loc"]):
            return what
        return f"unknown setting{_suggestion(details['loc'], settings)}"
    if details["type"] == "missing":
        return f"missing: {_description(details['loc'], settings)}"
    message = details["msg"].removeprefix("Value error, ")
    message = message[:1].lower() + message[1:]
    got = details["input"]
    # A validator over several fields names what it got itself.
    return message if isinstance(got, dict | BaseModel) else f"{message}, got {_shortened(got)}"


def _shortened(value: Any) -> str:
    """A value as a person can read it, without its end where it is long."""
    text = repr(value)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}…"


def _suggestion(location: Location, settings: type[BaseModel]) -> str:
    """The nearest name at the same place, else the same name elsewhere."""
    name = str(location[-1])[:_LONGEST_SHOWN]
    place = _model_at(location[:-1], settings)
    siblings = list(place.model_fields) if place else []
    if near := difflib.get_close_matches(name, siblings, n=1):
        return f"; perhaps you meant '{'.'.join(map(str, (*location[:-1], near[0])))}'"
    if elsewhere := [key for key in dotted_keys(settings) if key.split(".")[-1] == name]:
        return f"; perhaps you meant '{elsewhere[0]}'"
    return f"; known here: {', '.join(siblings)}" if siblings else ""


def _description(location: Location, settings: type[BaseModel]) -> str:
    place = _model_at(location[:-1], settings)
    field = place.model_fields.get(str(location[-1])) if place else None
    return (field.description if field else None) or "a value is needed"


def _model_at(location: Location, settings: type[BaseModel]) -> type[BaseModel] | None:
    """The settings class that a location leads to; keys of a dictionary and places in a list lead to its items."""
    model: type[BaseModel] | None = settings
    for part in location:
        if model is not None and part in model.model_fields:
            model = model_in(model.model_fields[str(part)].annotation)
    return model


def model_in(annotation: Any) -> type[BaseModel] | None:
    """The settings class within an annotation such as ``tuple[ObjectConfig, ...]`` or ``CameraConfig | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for inner in get_args(annotation) if (model := model_in(inner))), None)


def dotted_keys(settings: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Every setting that can be set by a dotted key."""
    for name, field in settings.model_fields.items():
        inner = model_in(field.annotation)
        if inner is None:
            yield prefix + name
        else:
            yield from dotted_keys(inner, f"{prefix}{name}.")
