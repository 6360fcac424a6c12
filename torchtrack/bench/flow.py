"""How long the flow of corners takes, and how well it is found: points that move over the sensor, each in a direction of its own."""

from functools import partial
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.bench.results import Report, time_result
from torchtrack.bench.setup import Setup
from torchtrack.config.tracker import FlowConfig
from torchtrack.tracking.frontend.bursts import LONG_AGO_US
from torchtrack.tracking.frontend.flow import estimate_flow
from torchtrack.tracking.frontend.sensor_maps import SensorMaps
from torchtrack.tracking.frontend.sensor_view import SensorPoints, SensorView
from torchtrack.tracking.frontend.time_surface import NEVER_US

# Both models; the paper's with the settings of its preset.
_MODELS = (FlowConfig(model="irls", radius_px=6, iterations=10), FlowConfig(model="arrival"))
# Corners in all, of objects of 32 each, which is what the preset takes.
CORNERS = (32, 256, 2048)
_OF_OBJECT = 32
_WIDTH, _HEIGHT = 640, 480
_T_US, _SPEED_PX_S = 1_000_000, 400.0
# Each corner has a cell of the sensor to itself, and its trail is so wide (px).
_CELL_PX, _TRAIL_PX = 12, 3


def measure(setup: Setup) -> Report:
    """Time of the flow, by the number of corners and by its model."""
    results, notes = [], []
    t_us = torch.tensor([_T_US], device=setup.device)
    ideal = torch.stack(torch.meshgrid(torch.arange(_WIDTH), torch.arange(_HEIGHT), indexing="xy"), -1)[None].float().to(setup.device)
    for count, config in product(CORNERS, _MODELS):
        name = f"{count} corners, {config.model}"
        setup.show(name)
        points, maps, true_flow = moving_points(count, setup.device)
        stream = torch.zeros(len(points.mask), dtype=torch.int64, device=setup.device)
        estimate = partial(torch.inference_mode()(estimate_flow), points, SensorView(maps, t_us, ideal, stream), config)
        results.append(time_result(name, setup.clock.seconds(estimate, setup.repeats)))
        flow, has_flow = estimate()
        error = (flow - true_flow).norm(dim=-1)[has_flow] / _SPEED_PX_S
        notes.append(f"{name}: {float(has_flow.float().mean()):.0%} have a flow, median error {float(error.median()):.1%} of the speed")
    return Report("flow", f"Flow of corners; {setup.clock.meaning}", tuple(results), tuple(notes))


def moving_points(count: int, device: torch.device) -> tuple[SensorPoints, SensorMaps, Float[Tensor, "b n 2"]]:
    """Points that have just come to the middle of their cells, each with its trail behind it.

    Returns:
        The corners, the maps of the sensor, and the velocity of each corner (px/s).
    """
    number = torch.arange(count)
    columns = _WIDTH // _CELL_PX
    centre = torch.stack([number % columns, number // columns], -1) * _CELL_PX + _CELL_PX // 2
    angle = 2 * torch.pi * number / count
    heading = torch.stack([angle.cos(), angle.sin()], -1)
    step = torch.arange(-(_CELL_PX // 2), _CELL_PX // 2)
    offsets = torch.stack(torch.meshgrid(step, step, indexing="xy"), -1).flatten(0, 1)
    along, across = heading @ offsets.T.float(), heading.flip(-1) * torch.tensor([-1.0, 1.0]) @ offsets.T.float()
    on_trail = (along <= 0) & (across.abs() <= _TRAIL_PX / 2)
    newest_us = torch.full((1, _HEIGHT, _WIDTH), NEVER_US)
    u, v = (centre[:, None] + offsets).unbind(-1)
    newest_us[0, v, u] = torch.where(on_trail, _T_US + (1e6 / _SPEED_PX_S * along).round().long(), NEVER_US)
    sensor = centre.unflatten(0, (-1, _OF_OBJECT)).to(device)
    mask = torch.ones(sensor.shape[:2], dtype=torch.bool, device=device)
    still = torch.zeros(mask.shape, device=device)
    burst_age_us = (_T_US - newest_us).clamp(max=LONG_AGO_US).to(torch.int16)[:, None].expand(-1, 2, -1, -1).contiguous()
    maps = SensorMaps(newest_us.to(device), burst_age_us.to(device))
    return SensorPoints(sensor, still, still, mask), maps, (_SPEED_PX_S * heading).unflatten(0, (-1, _OF_OBJECT)).to(device)
