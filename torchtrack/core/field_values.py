"""Values of a dataclass by the names of its fields."""

from typing import Any


def field_values(value: Any) -> dict[str, Any]:
    """Each field's value: unlike those of ``vars``, a compiler of graphs can follow them, and what is kept beside fields is not among them."""
    return {name: getattr(value, name) for name in value.__dataclass_fields__}
