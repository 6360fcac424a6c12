"""What the sensors show at the end of a window, to look at it where the objects are: their maps at that time, and points of them."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.tracking.frontend.sensor_maps import SensorMaps


@dataclass(frozen=True)
class SensorView:
    """The maps of the sensors at a time, and which sensor each object is seen by.

    Args:
        maps: at ``t_us``.
        t_us: end of the window of each stream.
        ideal_pixels: undistortion table of each stream.
        stream_index: the stream that each object is seen in.
    """

    maps: SensorMaps
    t_us: Int[Tensor, "s"]
    ideal_pixels: Float[Tensor, "s h w 2"]
    stream_index: Int[Tensor, "b"]


@dataclass(frozen=True)
class SensorPoints:
    """Corners and events on the sensor, padded.

    Args:
        sensor_pixels: integer sensor pixels (u, v).
        age_s: time from the event there to the window's end (s).
        polarity: of the event, 1 or -1; 0 where it is not known.
        mask: which entries exist.
    """

    sensor_pixels: Int[Tensor, "b n 2"]
    age_s: Float[Tensor, "b n"]
    polarity: Float[Tensor, "b n"]
    mask: Bool[Tensor, "b n"]
