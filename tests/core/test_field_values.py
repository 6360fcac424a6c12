"""Values of a dataclass by the names of its fields."""

from dataclasses import dataclass

from torchtrack.core.field_values import field_values


@dataclass(frozen=True)
class Pair:
    first: int
    second: list[int] | None = None


def test_values_are_those_of_fields_in_their_order_and_no_others():
    pair = Pair(1, [2])
    pair.__dict__["kept"] = 3
    assert list(field_values(pair).items()) == [("first", 1), ("second", pair.second)]
    assert field_values(pair)["second"] is pair.second
