"""Settings of where events come from, and what is done with them before they are tracked."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from torchtrack.config.settings import Settings, absolute_path
from torchtrack.core.column_names import TimeUnit as TimeUnit

_LIVE = re.compile(r"(dv|evk4|davis|stdin|ros)://\S*|-")


def is_live(source: Path | str) -> bool:
    """Whether a source is a camera or a stream, not a file: ``dv://HOST:PORT``, ``evk4://``, ``davis://``, ``ros://``, ``stdin://`` or ``-``."""
    return isinstance(source, str) and _LIVE.fullmatch(source) is not None


def _file_or_live(value: Any, info: Any) -> Any:
    """A live source as it is, or an absolute path; ``info`` is pydantic's ValidationInfo."""
    if not isinstance(value, str | Path):
        raise ValueError("expected the path of a file, or a live source")
    return str(value) if is_live(value) else absolute_path(value, info)


EventSourcePath = Annotated[Path | str, BeforeValidator(_file_or_live)]


class ReadingConfig(Settings):
    """How a file of events is read where it leaves a choice."""

    time_unit: TimeUnit | None = Field(
        None, description="Unit of the times, where a file does not say it: s, ms, us or ns; by default its format's custom."
    )
    polarity: Literal["auto", "inverted"] | int = Field(
        "auto", description="Which events got brighter: auto takes 0/1 and -1/1; inverted, the others; a number, those that have it."
    )
    topic: str | None = Field(None, description="Of a file with several streams of events: topic, stream, camera or group to read.")


class EventsConfig(ReadingConfig):
    """What is done with events before they are tracked; the camera follows by itself."""

    strict: bool = Field(False, description="What is wrong in a file is an error; otherwise it is left out, counted and reported.")
    region: tuple[int, int, int, int] | None = Field(None, description="Part of the sensor to use: left, top, columns, rows (px).")
    downscale: int = Field(1, ge=1, le=16, description="So many pixels become one, in each direction; for HD sensors.")
    hot_pixels: bool = Field(False, description="Leave out pixels that fire all the time, found in the first half second of a file.")
    background_us: int | None = Field(None, ge=1, description="Leave out events without a neighbour that fired in so many µs before.")
    live_windows: int = Field(
        64, ge=1, le=100_000, description="Windows of a live source that may wait; of more, the oldest are joined and their events thinned out."
    )
