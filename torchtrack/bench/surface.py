"""How fast events become a time surface: a window of events into the map of newest times, and the map into an object's region."""

import torch

from torchtrack.bench.results import Report, Result, time_result
from torchtrack.bench.setup import Setup
from torchtrack.config.tracker import SurfaceConfig
from torchtrack.core.events import EventBatch
from torchtrack.tracking.frontend.time_surface import Regions, empty_last_event, time_surface, update_last_event

# Width, height and events of a window: at 4 and 20 Mev/s, and many at once.
WINDOWS = ((640, 480, 20_000), (640, 480, 100_000), (1280, 720, 100_000), (640, 480, 1_000_000))
# On one thread of a CPU.
TARGET_MEV_S = 300.0
WINDOW_US = 5000
# Side of an object's region (px).
REGION_PX = 208


def random_events(width: int, height: int, count: int, seed: int = 0) -> EventBatch:
    """Events of one window anywhere on the sensor: no cache helps there."""
    random = torch.Generator().manual_seed(seed)
    x, y, polarity = (torch.randint(limit, (count,), generator=random) for limit in (width, height, 2))
    t_us = torch.randint(1, WINDOW_US + 1, (count,), generator=random).sort().values
    return EventBatch(x.int(), y.int(), t_us, polarity > 0, torch.zeros(count, dtype=torch.int64))


def measure(setup: Setup) -> Report:
    """Speed of the map of newest times, and time of the surface."""
    results = [_of_map(setup, *window) for window in WINDOWS]
    for width, height in dict.fromkeys(window[:2] for window in WINDOWS):
        results.append(_of_surface(setup, width, height, (REGION_PX, REGION_PX)))
        results.append(_of_surface(setup, width, height, (height, width)))
    note = "The map before a window is kept: in short windows, most of the time is that of copying it."
    return Report("surface", f"Time surface; {setup.clock.meaning}", tuple(results), (note,))


def _of_map(setup: Setup, width: int, height: int, count: int) -> Result:
    name = f"newest times, {width}x{height}, {count:,} events"
    setup.show(name)
    newest, events = empty_last_event(1, height, width, setup.device), random_events(width, height, count).to(setup.device)
    seconds = setup.clock.seconds(lambda: update_last_event(newest, events), setup.repeats)
    return Result(name, "Mev/s", tuple(1e-6 * count / value for value in seconds), setup.cpu_target(TARGET_MEV_S))


def _of_surface(setup: Setup, width: int, height: int, size: tuple[int, int]) -> Result:
    name = f"surface, {width}x{height}, {size[1]}x{size[0]} px of it"
    setup.show(name)
    newest = update_last_event(empty_last_event(1, height, width), random_events(width, height, width * height // 4)).to(setup.device)
    zeros = torch.zeros(1, 2, dtype=torch.int64, device=setup.device)
    regions = Regions(zeros, torch.tensor([size[::-1]], device=setup.device), size, zeros[:, 0])
    t_us = torch.tensor([WINDOW_US], device=setup.device)

    def make() -> torch.Tensor:
        return time_surface(newest, t_us, regions, SurfaceConfig().tau_s, torch.float32)

    return time_result(name, setup.clock.seconds(make, setup.repeats))
