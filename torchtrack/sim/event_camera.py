"""An event camera, pixel by pixel: luminance frames in, events out. Torch, vectorised, the same on any device.

::

    camera = EventCamera(EventCameraConfig(), width=640, height=480, seed=0)
    state = camera.start(luminance, t_us=0)                       # [480, 640], linear in light
    state, events = camera.step(state, luminance_next, t_us=800)  # EventBatch with 0 < t <= 800

Between frames the log luminance of a pixel runs in a straight line, so frames must be dense (no point of the scene should
move more than half a pixel). ``step`` is pure: the state holds all that changes, the state of the random generator too.

What a pixel does, and where it is described:

- It compares ``log(luminance + dark level)`` with the level memorised at its last event and fires where the difference
  reaches its ON or OFF threshold: Lichtsteiner, Posch & Delbruck 2008, *A 128x128 120 dB 15 µs latency asynchronous temporal
  contrast vision sensor*. The dark level stands for dark current and parasitic photocurrent: Nozaki & Delbruck 2017,
  *Temperature and parasitic photocurrent effects in dynamic vision sensors*.
- Thresholds differ between pixels (normally distributed): Lichtsteiner 2008, fig. 12; Hu, Liu & Delbruck 2021, *v2e*.
- Crossing times are interpolated between frames, several per frame and pixel: Rebecq, Gehrig & Scaramuzza 2018, *ESIM*.
- After an event the pixel is held in reset for the refractory period; it memorises the level at the end of it
  (Lichtsteiner 2008). v2e drops the events of that period instead, but counts them in the memory.
- The memorised level leaks downwards, so a pixel at rest fires ON events at a steady rate: Nozaki & Delbruck 2017. Every
  pixel starts at a random phase of it; else all would wait a whole period, and then fire together.
- Shot noise fires ON and OFF events as a Poisson process, less often in bright light: v2e, with its factor of 0.25 at white.
- The photoreceptor is a first-order low pass of the log luminance, whose cutoff is proportional to the light (Lichtsteiner
  2008); as in v2e it does not fall below 20/275 of that at white. Its answer to a straight line is taken exactly.
- Hot pixels fire ON events as a Poisson process at rates that are exponentially distributed: Hu 2021 has noise rates that
  differ between pixels; the few that stand out in real sensors are modelled here alone.
- Time stamps are late by a constant latency and an exponentially distributed wait for the readout (Lichtsteiner
  2008: its arbiter). What is read out after the last frame is never seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError
from torchtrack.sim.fired import Fired, concatenate_fired, read_out
from torchtrack.sim.noise import HotPixels, rested, shot_noise
from torchtrack.sim.photoreceptor import cutoff_hz, response
from torchtrack.sim.sensor_profiles import EventCameraConfig

# No pixel is more sensitive than this, whatever the mismatch says (v2e has the same floor).
_MIN_THRESHOLD = 0.01
# Time of the last event of a pixel that has not fired: long before any time of a recording.
NEVER_US = -(2**62)


@dataclass(frozen=True)
class EventCameraState:
    """All that changes in an event camera; levels are log luminances.

    Args:
        light_level: log luminance at the last frame.
        log_level: what the photoreceptor makes of it; the same where its bandwidth has no limit.
        reference: memorised at the last event, less the leak since the start (see :class:`EventCamera`).
        last_event_us: :data:`NEVER_US` before the first event.
        in_reset: flat indices of the pixels that were still in reset at the last frame.
        start_us, frame_us: times of the first and the last frame.
        generator_state: of the random generator.
        pending: events that have fired but are not yet read out, at the times (µs) when they will be.
    """

    light_level: Float[Tensor, "h w"]
    log_level: Float[Tensor, "h w"]
    reference: Float[Tensor, "h w"]
    last_event_us: Int[Tensor, "h w"]
    in_reset: Int[Tensor, "k"]
    start_us: int
    frame_us: int
    generator_state: UInt8[Tensor, "g"]
    pending: Fired


@dataclass(frozen=True)
class _Pixels:
    """Some pixels during one frame interval; times are µs since its start.

    The *signal* is the log level plus what has leaked since the first frame: the memorised level leaks downwards, so seen
    from there the signal rises. It is ``level + slope * t``.
    """

    index: Int[Tensor, "n"]
    level: Float[Tensor, "n"]
    slope: Float[Tensor, "n"]
    reference: Float[Tensor, "n"]
    release_us: Float[Tensor, "n"]
    """End of the reset; nothing fires before."""

    def signal(self, t_us: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        return self.level + self.slope * t_us

    def __getitem__(self, chosen: Tensor) -> "_Pixels":
        return _Pixels(self.index[chosen], self.level[chosen], self.slope[chosen], self.reference[chosen], self.release_us[chosen])


class EventCamera:
    """An event camera with its fixed pattern of thresholds.

    Args:
        config: physical parameters.
        width, height: of the sensor, pixels.
        seed: of the thresholds and of all noise; drawn on the CPU, so that they are the same on any device.
        device: where frames live and events are made.
    """

    def __init__(self, config: EventCameraConfig, width: int, height: int, seed: int = 0, device: torch.device | str = "cpu") -> None:
        self.config, self.width, self.height, self.device = config, width, height, torch.device(device)
        generator = torch.Generator().manual_seed(seed)
        self.threshold_on = self._thresholds(config.threshold_on, generator)
        self.threshold_off = self._thresholds(config.threshold_off, generator)
        # Log units per µs; a pixel at rest then fires at the leak rate whatever its threshold.
        self._leak = self.threshold_on * (config.leak_rate_hz * 1e-6)
        self._hot_pixels = HotPixels(config, width * height, generator, self.device)
        self._first_generator_state = generator.get_state()

    def _thresholds(self, mean: float, generator: torch.Generator) -> Float[Tensor, "h w"]:
        deviation = torch.randn((self.height, self.width), generator=generator)
        return (mean + self.config.threshold_mismatch * deviation).clamp(min=_MIN_THRESHOLD).to(self.device)

    def start(self, luminance: Float[Tensor, "h w"], t_us: int = 0) -> EventCameraState:
        """State of pixels that have looked at ``luminance`` for long.

        Raises:
            EventDataError: if the frame has another size than the sensor, or holds values that are not finite or negative.
        """
        log_level = self._updated_level(torch.zeros_like(self.threshold_on), luminance, None)
        generator = _generator(self._first_generator_state)
        phase = torch.rand(log_level.shape, generator=generator).to(self.device)
        reference = log_level - self.threshold_on * phase if self.config.leak_rate_hz > 0 else log_level.clone()
        last_event_us = torch.full(log_level.shape, NEVER_US, dtype=torch.int64, device=self.device)
        in_reset = torch.zeros(0, dtype=torch.int64, device=self.device)
        return EventCameraState(log_level, log_level, reference, last_event_us, in_reset, t_us, t_us, generator.get_state(), Fired.none(self.device))

    def step(
        self, state: EventCameraState, luminance: Float[Tensor, "h w"], t_us: int, regions: Sequence[tuple[slice, slice]] | None = None
    ) -> tuple[EventCameraState, EventBatch]:
        """Events from the last frame (excluded) to ``t_us`` (included), sorted by time, then pixel.

        Args:
            state: after the last frame; it is not changed.
            luminance: the new frame, linear in light.
            t_us: its time, later than the last one.
            regions: rectangles (rows, columns) outside of which the luminance is that of the last frame; the whole when not given.

        Raises:
            EventDataError: if the frame has another size, holds values that are not finite or negative, or is not later.
        """
        state, events, _ = self.step_with_causes(state, luminance, t_us, regions)
        return state, events

    def step_with_causes(
        self, state: EventCameraState, luminance: Float[Tensor, "h w"], t_us: int, regions: Sequence[tuple[slice, slice]] | None = None
    ) -> tuple[EventCameraState, EventBatch, Bool[Tensor, "n"]]:
        """:meth:`step`, which also tells for every event whether it is noise: shot noise, a hot pixel, or leak alone."""
        if t_us <= state.frame_us:
            raise EventDataError(f"frames must come in time order: got one at {t_us} µs after one at {state.frame_us} µs.")
        duration_us = t_us - state.frame_us
        light_level = self._updated_level(state.light_level, luminance, regions)
        log_level = self._photoreceptor(state, light_level, duration_us)
        pixels, fired = self._fire(self._candidates(state, log_level, t_us), duration_us)
        last_event_us = _latest(state.last_event_us, fired, state.frame_us)
        generator = _generator(state.generator_state)
        noise = self._noise(log_level, last_event_us, state.frame_us, duration_us, generator)
        fired = replace(fired, is_noise=self._by_leak_alone(fired, state, log_level, duration_us))
        both = concatenate_fired([fired, noise], self.device).later(state.frame_us)
        ready, pending = read_out(state.pending, both, t_us, self.config, generator)
        last_event_us = _latest(last_event_us, noise, state.frame_us)
        reference = state.reference.clone()
        reference.view(-1)[pixels.index] = pixels.reference
        after = EventCameraState(
            light_level, log_level, reference, last_event_us, state.in_reset, state.start_us, t_us, generator.get_state(), pending
        )
        self._memorise(after, state, noise.index)
        touched = torch.cat([pixels.index, noise.index]).unique()
        in_reset = touched[last_event_us.view(-1)[touched] + self.config.refractory_us > t_us]
        return replace(after, in_reset=in_reset), *self._batch(ready)

    def _photoreceptor(self, state: EventCameraState, light_level: Float[Tensor, "h w"], duration_us: int) -> Float[Tensor, "h w"]:
        """What the photoreceptor makes of the new frame."""
        if not self.config.bandwidth_hz:
            return light_level
        cutoff = cutoff_hz(light_level.exp() - self.config.dark_level, self.config.bandwidth_hz)
        return response(state.log_level, state.light_level, light_level, cutoff, 1e-6 * duration_us)

    def _noise(
        self, log_level: Float[Tensor, "h w"], last_event_us: Int[Tensor, "h w"], start_us: int, duration_us: int, generator: torch.Generator
    ) -> Fired:
        """Shot noise and hot pixels of one interval, on pixels that are not in reset."""
        sources = [shot_noise(log_level, self.config, duration_us, generator), self._hot_pixels.fire(duration_us, generator)]
        noise = concatenate_fired(sources, self.device)
        return noise[rested(noise, last_event_us, start_us, self.config.refractory_us)]

    def _by_leak_alone(self, fired: Fired, state: EventCameraState, log_level: Float[Tensor, "h w"], duration_us: int) -> Bool[Tensor, "n"]:
        """Which events had more leak than change of light in their interval."""
        change = (log_level.view(-1)[fired.index] - state.log_level.view(-1)[fired.index]).abs()
        return change <= self._leak.view(-1)[fired.index] * duration_us

    def _updated_level(
        self, log_level: Float[Tensor, "h w"], luminance: Float[Tensor, "rows columns"], regions: Sequence[tuple[slice, slice]] | None
    ) -> Float[Tensor, "h w"]:
        """Log levels with the given rectangles renewed."""
        if luminance.shape != log_level.shape:
            raise EventDataError(f"expected frames of {self.width}x{self.height} pixels, got {luminance.shape[-1]}x{luminance.shape[0]}.")
        log_level = log_level.clone()
        for region in regions if regions is not None else [(slice(None), slice(None))]:
            light = luminance[region].to(log_level)
            if not bool(((light >= 0) & (light < torch.inf)).all()):
                raise EventDataError("luminance must be finite and not negative, linear in light with 1 for white. Check the renderer or the images.")
            log_level[region] = (light + self.config.dark_level).log()
        return log_level

    def _signal(self, state: EventCameraState, index: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Log level plus leak of some pixels, at the last frame."""
        return state.log_level.view(-1)[index] + self._leak.view(-1)[index] * (state.frame_us - state.start_us)

    def _candidates(self, state: EventCameraState, log_level: Float[Tensor, "h w"], t_us: int) -> _Pixels:
        """Pixels that reach a threshold by ``t_us``, and those that leave their reset and must memorise their level."""
        excess = torch.add(log_level, self._leak, alpha=t_us - state.start_us) - state.reference
        mask = ((excess >= self.threshold_on) | (excess <= -self.threshold_off)).view(-1)
        mask[state.in_reset] = True
        index = mask.nonzero().squeeze(1)
        level = self._signal(state, index)
        duration = t_us - state.frame_us
        slope = (self._signal(replace(state, log_level=log_level, frame_us=t_us), index) - level) / duration
        # Integers first: absolute times have too many digits for float32.
        release_us = (state.last_event_us.view(-1)[index] + self.config.refractory_us - state.frame_us).clamp(min=0).to(level.dtype)
        pixels = _Pixels(index, level, slope, state.reference.view(-1)[index], release_us)
        at_release = pixels.signal(release_us.clamp(max=duration))
        return replace(pixels, reference=torch.where(release_us > 0, at_release, pixels.reference))

    def _fire(self, pixels: _Pixels, duration_us: int) -> tuple[_Pixels, Fired]:
        """Follow the pixels through one interval, event by event; also returns what they memorise at its end."""
        reference, rounds = pixels.reference.clone(), []
        rising = pixels.slope > 0
        thresholds = torch.where(rising, self.threshold_on.view(-1)[pixels.index], -self.threshold_off.view(-1)[pixels.index])
        row = torch.arange(len(pixels.index), device=self.device)
        active = pixels
        while len(row):
            target = active.reference + thresholds[row]
            crossing_us = active.release_us + ((target - active.signal(active.release_us)) / active.slope).clamp(min=0)
            fires = (crossing_us <= duration_us) & (active.slope != 0)
            active, row, target = active[fires], row[fires], target[fires]
            event_us = crossing_us[fires].ceil().clamp(1, duration_us)
            rounds.append(Fired(active.index, event_us.long(), rising[row], torch.zeros_like(row, dtype=torch.bool)))
            release_us = event_us + self.config.refractory_us
            # Without a reset the pixel memorises the very level that it reached.
            memorised = active.signal(release_us.clamp(max=duration_us)) if self.config.refractory_us else target
            reference[row] = memorised
            active = replace(active, reference=memorised, release_us=release_us)
        return replace(pixels, reference=reference), concatenate_fired(rounds, self.device)

    def _memorise(self, after: EventCameraState, before: EventCameraState, index: Int[Tensor, "n"]) -> None:
        """Let pixels memorise their level at the end of the reset that follows their last event, in ``after.reference``."""
        release_us = after.last_event_us.view(-1)[index] + self.config.refractory_us
        fraction = (release_us.clamp(max=after.frame_us) - before.frame_us).double() / (after.frame_us - before.frame_us)
        after.reference.view(-1)[index] = torch.lerp(self._signal(before, index), self._signal(after, index), fraction.to(after.reference))

    def _batch(self, fired: Fired) -> tuple[EventBatch, Bool[Tensor, "n"]]:
        """Events sorted by time, then pixel, and which of them are noise."""
        # Times since the first: an absolute one times the number of pixels could overflow.
        first_us = fired.t_us.min() if len(fired) else 0
        order = torch.argsort((fired.t_us - first_us) * (self.width * self.height) + fired.index, stable=True)
        index = fired.index[order]
        x, y = (index % self.width).int(), torch.div(index, self.width, rounding_mode="floor").int()
        return EventBatch(x, y, fired.t_us[order], fired.polarity[order], torch.zeros_like(index)), fired.is_noise[order]


def _generator(state: UInt8[Tensor, "g"]) -> torch.Generator:
    generator = torch.Generator()
    generator.set_state(state)
    return generator


def _latest(last_event_us: Int[Tensor, "h w"], fired: Fired, start_us: int) -> Int[Tensor, "h w"]:
    """Times of the last events with new ones added; a pixel may have fired several times."""
    flat = last_event_us.view(-1).scatter_reduce(0, fired.index, fired.t_us + start_us, "amax")
    return flat.view_as(last_event_us)
