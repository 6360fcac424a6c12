"""One of several streams that a file has: the one that is asked for, or the first, which is told."""

import warnings
from collections.abc import Sequence

from torchtrack.errors import EventDataError, TorchtrackWarning

_SETTING = "events.topic (--topic)"


def chosen_stream(names: Sequence[str], wanted: str | None, source: str) -> str:
    """The name of the stream to read, of one or more that a file has.

    Args:
        names: of the streams, the one that is read by default first.
        wanted: the one that the user asks for, if any.
        source: name of the source, for messages.

    Raises:
        EventDataError: if there is no stream of the name that is asked for.
    """
    if wanted is not None:
        if wanted not in names:
            raise EventDataError(
                f"{source}: there are no events named '{wanted}'; its streams of events are: {', '.join(names)}. Correct {_SETTING}."
            )
        return wanted
    if len(names) > 1:
        others = ", ".join(f"'{name}'" for name in names[1:])
        message = f"{source}: of its {len(names)} streams of events, '{names[0]}' is read; the others are {others}. Choose one with {_SETTING}."
        warnings.warn(message, TorchtrackWarning, stacklevel=2)
    return names[0]
