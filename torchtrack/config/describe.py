"""Every setting, for people to look up."""

from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from torchtrack.config.explain import model_in

_SIGNS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
_PLAIN_NAMES: dict[Any, str] = {NoneType: "null", str: "text", Path: "path"}


def described(settings: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str, str, str]]:
    """Dotted key, type, default and meaning of every setting; items of lists and mappings are shown as ``[]``."""
    for name, field in settings.model_fields.items():
        inner = model_in(field.annotation)
        if inner is None:
            yield prefix + name, _type_name(field.annotation), _default(field), _meaning(field)
        else:
            several = get_origin(field.annotation) in (tuple, dict)
            yield from described(inner, f"{prefix}{name}{'[]' if several else ''}.")


def _type_name(annotation: Any) -> str:
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _type_name(inner[0])
    if origin is Literal:
        return " | ".join(inner)
    if origin in (Union, UnionType):
        return " | ".join(_type_name(member) for member in inner)
    if origin in (tuple, frozenset):
        return "list"
    return _PLAIN_NAMES.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "needed"
    default = field.get_default(call_default_factory=True, validated_data={})
    if default is None:
        return "-"
    if isinstance(default, Path):
        # Within the working folder, which differs from user to user.
        return str(default.relative_to(Path.cwd())) if default.is_relative_to(Path.cwd()) else str(default)
    return str(list(default)) if isinstance(default, tuple | frozenset) else str(default).lower() if isinstance(default, bool) else str(default)


def _meaning(field: FieldInfo) -> str:
    bounds = [f"{sign} {getattr(limit, name)}" for limit in field.metadata for name, sign in _SIGNS.items() if getattr(limit, name, None) is not None]
    return (field.description or "") + (f" [{', '.join(bounds)}]" if bounds else "")
