"""Stages between a stream of events and whoever uses it: each is a stream itself, in constant memory."""

from torchtrack.io.filters.background import BackgroundFilter
from torchtrack.io.filters.hot_pixels import HotPixelFilter, find_hot_pixels
from torchtrack.io.filters.resize import Downscaled, Region, downscaled_camera, region_camera

__all__ = ["BackgroundFilter", "Downscaled", "HotPixelFilter", "Region", "downscaled_camera", "find_hot_pixels", "region_camera"]
