"""Who is looked for in a window: a bounded number of a stream's objects, so that the others do not wait for all that are lost.

If more objects have triggers than there are looks, those come first that were looked for least often since they were last seen well, and of
these, those that are lost longest: one that stays lost keeps no other one waiting. Streams do not matter to one another. What merely waits for
its pose to be confirmed takes no look from what is lost: there are as many more for it.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from torchtrack.core.constants import constant
from torchtrack.tracking.relocalization.triggers import SEARCHED, Trigger


@dataclass(frozen=True)
class Asks:
    """What an object's triggers ask for.

    Args:
        number: of the object, and ``stream`` that it is in.
        flags: its triggers.
        looks: in how many windows it was looked for since it was last seen well.
        lost_s: how long ago that was (s).
        is_starting: whether its motion is not known yet.
    """

    number: int
    stream: int
    flags: int
    looks: int
    lost_s: float
    is_starting: bool

    @property
    def is_confirming(self) -> bool:
        """Whether nothing but a confirmation is asked for."""
        return self.flags & SEARCHED == Trigger.UNCONFIRMED


def in_turn(asking: Sequence[Asks], most: int) -> list[Asks]:
    """Those that there are looks for, in the order of their numbers.

    Objects whose motion is not known yet are all looked for: this is so for their first window alone, and later they are somewhere else.

    Args:
        asking: objects with triggers.
        most: how many looks there are in each stream for the others, and as many for confirmations.
    """
    chosen, left = [], Counter(dict.fromkeys(((asks.stream, asks.is_confirming) for asks in asking), most))
    for asks in sorted(asking, key=lambda asks: (asks.looks, -asks.lost_s)):
        if asks.is_starting or left[asks.stream, asks.is_confirming]:
            chosen.append(asks)
            left[asks.stream, asks.is_confirming] -= not asks.is_starting
    return sorted(chosen, key=lambda asks: asks.number)


def among(numbers: Sequence[int], objects: Bool[Tensor, "b"]) -> Bool[Tensor, "b"]:
    """Which of some objects have these numbers."""
    chosen = set(numbers)
    return constant(tuple(number in chosen for number in range(len(objects))), torch.bool, objects.device)
