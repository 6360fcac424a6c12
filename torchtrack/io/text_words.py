"""Single words of text files of events: coordinates and polarities."""

import numpy as np

from torchtrack.io.columns import Columns
from torchtrack.io.polarity_code import PolarityChoice, PolarityCode
from torchtrack.io.problems import Problems

_SWITCH = {"true": 1, "false": 0, "on": 1, "off": 0}


def parse_whole(word: str) -> int:
    """A pixel coordinate; ``162.0`` counts as whole, ``162.5`` does not.

    Raises:
        ValueError: if it is no whole number of 32 bits.
    """
    if word.isdigit() and len(word) < 10:
        return int(word)
    value = float(word)
    if "_" in word or not value.is_integer() or abs(value) >= 2**31:
        raise ValueError(f"'{word}' is not a whole number of pixels or a polarity")
    return int(value)


def parse_polarity(word: str) -> int:
    """A polarity: a whole number, or on or off in words.

    Raises:
        ValueError: if it is neither.
    """
    known = _SWITCH.get(word.lower())
    return parse_whole(word) if known is None else known


def settled_polarity(words: list[str], choice: PolarityChoice, problems: Problems) -> None:
    """Check the polarities at the beginning of a file, before anything of it is read.

    Raises:
        EventDataError: if their code is none that is known, and nobody says what it means.
    """
    values = []
    for word in words:
        try:
            values.append(parse_polarity(word))
        except ValueError:
            continue
    none = np.zeros(len(values), np.int64)
    PolarityCode(choice, problems).applied(Columns(none, none, none, np.array(values, np.int64)))


def as_numbers(words: list[str]) -> np.ndarray:
    """Words as numbers; NaN where they are none."""
    numbers = np.full(len(words), np.nan)
    for place, word in enumerate(words):
        try:
            numbers[place] = float(word)
        except ValueError:
            continue
    return numbers
