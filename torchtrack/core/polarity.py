"""How polarities are coded: 0 and 1, or -1 and 1; any other code is a question, not a guess."""

from collections.abc import Callable

import numpy as np

from torchtrack.errors import EventDataError

# More values than these are not listed in a message.
_MOST_SHOWN = 6


def known_codes(values: np.ndarray) -> np.ndarray | None:
    """Where values are codes that are known, as a mask; None where all of them are, which is found out fast.

    -1, 0 and 1 together are no code: the zeros could mean either.
    """
    if len(values) == 0 or values.dtype.kind == "b":
        return None
    least, most = values.min(), values.max()
    if values.dtype.kind in "iu" and most <= 1 and least >= 0:
        return None
    known = (values == 1) | (values == (-1 if (values == -1).sum() > (values == 0).sum() else 0))
    return None if known.all() else known


def brighter(values: np.ndarray, source: str = "events", advice: Callable[[np.ndarray], str] | None = None) -> np.ndarray:
    """Where it got brighter, of values that are 0 or 1, -1 or 1, or booleans.

    Args:
        values: polarities, of any numeric type.
        source: name of the source, for messages.
        advice: what the user can do about such values, for messages.

    Raises:
        EventDataError: if there is another value.
    """
    if values.dtype.kind == "b":
        return values
    if known_codes(values) is not None:
        raise EventDataError(f"{source}: polarity holds {shown_values(values)}; expected 0 and 1, or -1 and 1.{advice(values) if advice else ''}")
    result: np.ndarray = values > 0
    return result


def shown_values(values: np.ndarray) -> str:
    """The values that there are, for a message."""
    distinct = np.unique(values)
    text = [f"{value:g}" for value in distinct[:_MOST_SHOWN].tolist()]
    return ", ".join(text) + ", …" if len(distinct) > _MOST_SHOWN else " and ".join([", ".join(text[:-1]), text[-1]] if len(text) > 1 else text)
