"""Time surfaces of a whole sensor: ours, tonic's and dv-processing's."""

from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.bench.peers.comparison import Comparison, Work
from torchtrack.bench.surface import WINDOW_US, random_events
from torchtrack.config.tracker import SurfaceConfig
from torchtrack.core.events import EventBatch
from torchtrack.tracking.frontend.time_surface import Regions, empty_last_event, time_surface, update_last_event

WIDTH, HEIGHT, EVENTS = 640, 480, 100_000
_TAU_S = SurfaceConfig().tau_s


def compare(comparison: Comparison) -> None:
    """Measure all that are here."""
    events = random_events(WIDTH, HEIGHT, EVENTS)
    end_us = int(events.t_us[0]) + WINDOW_US
    device = comparison.setup.device
    newest, on_device = empty_last_event(1, HEIGHT, WIDTH, device), events.to(device)
    zeros = torch.zeros(1, 2, dtype=torch.int64, device=device)
    whole = Regions(zeros, torch.tensor([[WIDTH, HEIGHT]], device=device), (HEIGHT, WIDTH), zeros[:, 0])
    t_us = torch.tensor([end_us], device=device)

    def ours() -> Float[Tensor, "1 h w"]:
        return time_surface(update_last_event(newest, on_device), t_us, whole, _TAU_S, torch.float32)

    name = f"surface of {EVENTS:,} events, {WIDTH}x{HEIGHT}"
    our_result = comparison.time(f"{name}: torchtrack", ours)
    expected = ours()[0].cpu().numpy()
    if (work := comparison.prepare(f"{name}: tonic", "tonic", partial(_tonic, events))) is not None:
        comparison.ahead(comparison.time(f"{name}: tonic", work), our_result)
        difference = np.abs(work() - expected).max()
        comparison.notes.append(f"{name}: tonic: equal to ours to {difference:.1g}")
    if (work := comparison.prepare(f"{name}: dv-processing", "dv-processing", partial(_dv, events))) is not None:
        comparison.ahead(comparison.time(f"{name}: dv-processing", work), our_result)
        seen = expected > 0
        wrong = int((seen != (work() > 0)).sum())
        comparison.notes.append(f"{name}: dv-processing: falls linearly, in 8 bits; {wrong} pixels are set in one of both alone")


def _tonic(events: EventBatch) -> Work:
    from tonic.functional import to_timesurface_numpy

    plain = np.zeros(len(events), dtype=[("x", int), ("y", int), ("t", int), ("p", int)])
    plain["x"], plain["y"], plain["t"] = events.x.numpy(), events.y.numpy(), events.t_us.numpy()

    def make() -> np.ndarray:
        surface: np.ndarray = to_timesurface_numpy(plain, (WIDTH, HEIGHT, 1), WINDOW_US, _TAU_S * 1e6, include_incomplete=True)[0, 0]
        return surface

    return make


def _dv(events: EventBatch) -> Work:
    import dv_processing

    store = dv_processing.EventStore()
    for t_us, x, y, polarity in zip(events.t_us.tolist(), events.x.tolist(), events.y.tolist(), events.polarity.tolist(), strict=True):
        store.push_back(t_us, x, y, polarity)

    def make() -> np.ndarray:
        surface = dv_processing.TimeSurface((WIDTH, HEIGHT))
        surface.accept(store)
        image: np.ndarray = surface.generateFrame().image
        return image

    return make
