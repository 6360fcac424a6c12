"""What ``scripts/stress`` runs: a simulated object that swings to and fro, its stream broken in every known way, tracked for long."""

import argparse
import os
import time
import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import torch

import torchtrack
from torchtrack.bench.scene import Scene, simulated
from torchtrack.config.presets import preset
from torchtrack.config.tracker import WindowConfig
from torchtrack.core.events import EventBatch
from torchtrack.core.windows import LONGEST_SILENCE_US
from torchtrack.errors import TorchtrackWarning
from torchtrack.io.problems import Problems
from torchtrack.tracking.validation.status import Status

PACKET_US, WINDOW_US, HOUR_US = 2_000, 5_000, 3_600_000_000
# Every so many packets: late, twice, clock back by 0.1 s, by 1000 s, a gap of 50 ms, an hour forward, a burst of noise, a wild time.
LATE, TWICE, BACK, FAR_BACK, GAP, FORWARD, BURST, WILD = 53, 101, 5_003, 25_013, 2_003, 20_011, 1_009, 499
HOT_PIXELS, BURST_EVENTS = 5, 5_000
# Once in so many windows, a fixed one is taken again: its time is that of a step on this machine now, whatever else runs there.
REFERENCE_EVERY = 50
Packet = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def swinging(scene: Scene) -> Iterator[Packet]:
    """Packets of x, y, t and polarity without end: the scene forward, then mirrored in time, and so on."""
    events = scene.events
    x, y, t_us, polarity = (values.numpy() for values in (events.x, events.y, events.t_us, events.polarity))
    length_us = int(t_us[-1]) // PACKET_US * PACKET_US
    inside = t_us < length_us
    forward = (x[inside], y[inside], t_us[inside], polarity[inside])
    mirrored = (forward[0][::-1], forward[1][::-1], (length_us - 1 - forward[2])[::-1], ~forward[3][::-1])
    start_us = 0
    while True:
        for fx, fy, ft, fp in (forward, mirrored):
            for cut in np.split(np.arange(len(ft)), np.searchsorted(ft, np.arange(PACKET_US, length_us, PACKET_US))):
                yield fx[cut], fy[cut], ft[cut] + start_us, fp[cut]
            start_us += length_us


class Faults:
    """Breaks a stream.

    Attributes:
        shift_us: what the clock shows beyond the time that passed.
        hours: how often it jumped forward by an hour.
    """

    def __init__(self, scene: Scene) -> None:
        self.shift_us, self.hours = 2**32 - 30_000_000, 0
        self._width, self._height = scene.camera.width, scene.camera.height
        self._random = np.random.default_rng(0)
        self._hot = self._random.integers(0, (self._width, self._height), (HOT_PIXELS, 2))

    def applied_to(self, packets: Iterator[Packet], duration_us: int) -> Iterator[EventBatch]:
        """The packets of a time, as they come."""
        held: EventBatch | None = None
        for number, packet in enumerate(packets, 1):
            if number * PACKET_US > duration_us:
                return
            self._change_clock(number)
            if number % GAP < 25:
                continue
            batch = self._batch(packet, number)
            if number % LATE == 0:
                held = batch
                continue
            yield batch
            if number % TWICE == 0:
                yield batch
            if held is not None:
                yield held
                held = None

    def _change_clock(self, number: int) -> None:
        if number % BACK == 0:
            self.shift_us -= 100_000
        if number % FAR_BACK == 0:
            self.shift_us -= 1_000_000_000
        if number % FORWARD == 0:
            self.shift_us += HOUR_US
            self.hours += 1

    def _batch(self, packet: Packet, number: int) -> EventBatch:
        x, y, t_us, polarity = packet
        start_us, extra = (number - 1) * PACKET_US, 2 * HOT_PIXELS + (BURST_EVENTS if number % BURST == 0 else 0)
        more_t = self._random.integers(start_us, start_us + PACKET_US, extra)
        more_x, more_y = self._random.integers(0, self._width, extra), self._random.integers(0, self._height, extra)
        more_x[: 2 * HOT_PIXELS], more_y[: 2 * HOT_PIXELS] = np.tile(self._hot, (2, 1)).T
        t_us = np.concatenate([t_us, more_t])
        order = np.argsort(t_us, kind="stable")
        shown = (t_us[order] + self.shift_us) % 2**32 if self.hours == 0 else t_us[order] + self.shift_us
        if number % WILD == 0:
            shown[len(shown) // 2] += 10**12
        columns = (np.concatenate(pair)[order] for pair in ((x, more_x), (y, more_y)))
        brighter = np.concatenate([polarity, more_t % 2 > 0])[order]
        return EventBatch.from_numpy(*columns, shown, brighter)


class ReferenceStep:
    """The same window taken again and again, from the same state.

    Args:
        tracker: that takes it.
        state: before it.
        packets: of events without end.
    """

    def __init__(self, tracker: torchtrack.Tracker, state: torchtrack.TrackerState, packets: Iterator[Packet]) -> None:
        self.seconds: list[float] = []
        self._tracker = tracker
        start_us = int(state.t_us[0])
        for number in range(1, 20):
            x, y, t_us, polarity = (np.concatenate(column) for column in zip(*islice(packets, 2), strict=True))
            self._before, self._events = state, EventBatch.from_numpy(x, y, t_us + start_us, polarity)
            self._end_us = start_us + 2 * PACKET_US * number
            state = self._step(state, self._end_us)

    def take(self) -> None:
        """Take it once more."""
        begun = time.process_time()
        self._step(self._before, self._end_us)
        self.seconds.append(time.process_time() - begun)

    def _step(self, state: torchtrack.TrackerState, end_us: int) -> torchtrack.TrackerState:
        with torch.inference_mode():
            return self._tracker.step(state, self._events, end_us)[0]


def resident_mb() -> float:
    """Memory of this process (MB)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> int:
    """Track, and print what came of it; 1 where a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0, help="event time")
    parser.add_argument("--first", type=float, default=1.0, help="what the end is compared with: memory and time per step after so many minutes")
    given = parser.parse_args()
    scene = simulated(("lbracket",), size=(320, 240))
    faults, problems = Faults(scene), Problems("the stream", strict=False)
    tracker = torchtrack.Tracker(scene.models, scene.camera, preset("causal"))
    state = tracker.init(scene.T_cam_obj, faults.shift_us)
    tracker.prepare(state)
    window = WindowConfig(mode="time", duration_us=WINDOW_US)
    duration_us = round(60e6 * given.minutes)
    per_minute = round(60e6 * given.first) // WINDOW_US
    warnings.simplefilter("ignore", TorchtrackWarning)
    reference = ReferenceStep(tracker, state, swinging(scene))
    tracked, seconds, table, begun = 0, [], [], time.process_time()
    for count, result in enumerate(torchtrack.track(faults.applied_to(swinging(scene), duration_us), tracker, state, window, problems), 1):
        seconds.append(time.process_time() - begun)
        if count % REFERENCE_EVERY == 0:
            reference.take()
        begun = time.process_time()
        tracked += int(result.status[0]) == int(Status.TRACKING)
        if count % per_minute == 0:
            step_s, reference_s = float(np.median(seconds)), float(np.median(reference.seconds))
            table.append((step_s / reference_s, resident_mb()))
            line = f"step {1e3 * step_s:.2f} ms, {table[-1][0]:.3f} of the fixed one, {table[-1][1]:.0f} MB, tracked {tracked / count:.1%}"
            print(f"minute {count * WINDOW_US / 6e7:5.1f}: {line}", flush=True)
            seconds, reference.seconds = [], []
    expected = duration_us // WINDOW_US + faults.hours * (LONGEST_SILENCE_US // WINDOW_US + 1)
    slower, larger = (table[-1][column] / table[0][column] - 1 for column in (0, 1)) if len(table) > 1 else (0.0, 0.0)
    print(f"windows: {count:,} of {expected:,} expected; tracked {tracked / count:.1%}; time per step {slower:+.1%}, memory {larger:+.1%}")
    print(f"the stream: {problems}")
    missed = [name for name, bad in (("windows", abs(count - expected) > 0.01 * expected), ("time", slower > 0.05), ("memory", larger > 0.05)) if bad]
    print(f"missed: {', '.join(missed)}" if missed else "all bounds are met")
    return int(bool(missed))


if __name__ == "__main__":
    raise SystemExit(main())
