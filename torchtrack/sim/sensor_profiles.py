"""Physical parameters of event cameras, and sets of them that go together.

Each effect, with where it is described, is in :mod:`torchtrack.sim.event_camera`.
"""

from pydantic import Field

from torchtrack.config.settings import Settings


class EventCameraConfig(Settings):
    """Physical parameters of an event camera; the defaults are those of a good sensor in good light."""

    threshold_on: float = Field(0.2, gt=0, le=2, description="Mean ON contrast threshold, log units (0.2: 22 % brighter).")
    threshold_off: float = Field(0.2, gt=0, le=2, description="Mean OFF contrast threshold, log units.")
    threshold_mismatch: float = Field(0.03, ge=0, le=0.5, description="Standard deviation of the thresholds between pixels, log units.")
    refractory_us: int = Field(100, ge=0, le=1_000_000, description="Time in reset after an event, µs.")
    leak_rate_hz: float = Field(0.1, ge=0, le=100, description="Rate of leak events (ON) of a pixel at rest, Hz.")
    shot_noise_rate_hz: float = Field(0.2, ge=0, le=1000, description="Rate of shot noise events (ON and OFF) of a pixel in the dark, Hz.")
    dark_level: float = Field(0.005, gt=0, le=1, description="Dark current as a luminance, where 1 is white.")
    bandwidth_hz: float = Field(0, ge=0, le=100_000, description="Photoreceptor's cutoff (-3 dB) at white, Hz; it falls with the light. 0: no limit.")
    hot_pixel_share: float = Field(0, ge=0, le=0.1, description="Share of pixels that fire all the time.")
    hot_pixel_rate_hz: float = Field(100, ge=0, le=10_000, description="Mean rate of a hot pixel (ON), Hz.")
    jitter_us: float = Field(0, ge=0, le=10_000, description="Mean of the random wait of an event for its readout, µs.")
    latency_us: int = Field(
        0, ge=0, le=1_000_000, description="Constant delay of every time stamp, µs; a run takes it off by its own sensor_latency_us."
    )


EVENT_CAMERA_PROFILES = {
    "ideal": EventCameraConfig(threshold_mismatch=0, refractory_us=0, leak_rate_hz=0, shot_noise_rate_hz=0),
    "default": EventCameraConfig(),
    "realistic": EventCameraConfig(shot_noise_rate_hz=1.0, refractory_us=300, bandwidth_hz=300, hot_pixel_share=1e-4, jitter_us=20),
}
