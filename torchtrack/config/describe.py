"""Every setting, for people to look up."""

from collections.abc import Iterator
from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from torchtrack.config.explain import model_in


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
    if annotation is type(None):
        return "null"
    if get_args(annotation) and get_origin(annotation) is not tuple:
        return " | ".join(value if isinstance(value, str) else _type_name(value) for value in get_args(annotation))
    if get_origin(annotation) is tuple:
        return "list"
    return {"str": "text", "PosixPath": "path", "WindowsPath": "path", "Path": "path"}.get(annotation.__name__, annotation.__name__)


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "needed"
    default = field.get_default(call_default_factory=not field.default_factory_takes_validated_data)
    if default is None:
        return "-"
    return str(list(default)) if isinstance(default, tuple) else str(default).lower() if isinstance(default, bool) else str(default)


def _meaning(field: FieldInfo) -> str:
    bounds = [f"{sign} {getattr(limit, name)}" for limit in field.metadata for name, sign in _SIGNS.items() if getattr(limit, name, None) is not None]
    return (field.description or "") + (f" [{', '.join(bounds)}]" if bounds else "")


_SIGNS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
