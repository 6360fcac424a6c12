"""Flow at events of simulated scenes, beside how fast their contours truly move across themselves."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from torchtrack import Tracker
from torchtrack.config.run import RunConfig
from torchtrack.config.tracker import FlowConfig, TrackerConfig
from torchtrack.core.events import concatenate
from torchtrack.core.lie import transform_points
from torchtrack.run.session import open_session
from torchtrack.tracking.association.observations import select_events
from torchtrack.tracking.contours.index import index_contours
from torchtrack.tracking.expectation import predicted_after
from torchtrack.tracking.frontend.flow import estimate_flow
from torchtrack.tracking.frontend.sensor_view import SensorPoints
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.frontend.time_surface import update_last_event
from torchtrack.tracking.initialization import first_state

# The paper's settings, and those of the arrival flow.
MODELS = {"irls": FlowConfig(model="irls", radius_px=6, iterations=10), "arrival": FlowConfig(model="arrival")}
WINDOW_US, WARM_UP_US, EVERY = 5_000, 60_000, 12
# Events this near to a contour at its true pose are looked at (px), of contours that move so fast across themselves (px/s).
NEAR_PX, LEAST_SPEED_PX_S = 1.2, 50.0


@dataclass(frozen=True)
class FlowErrors:
    """How the normal flow of events compares with the truth.

    Args:
        ratio: of the flow's part along the contour's normal and the contour's true speed along it, of each event that has a flow.
        angle_deg: between the flow and the object's true motion there.
        known: share of the events that have a flow.
    """

    ratio: torch.Tensor
    angle_deg: torch.Tensor
    known: float

    @property
    def quartiles(self):
        return tuple(float(value) for value in self.ratio.quantile(torch.tensor([0.25, 0.5, 0.75], dtype=self.ratio.dtype)))

    @property
    def sign_right(self):
        return float((self.ratio > 0).double().mean())

    def row(self):
        """As in docs/method.md."""
        low, middle, high = self.quartiles
        within = float(((self.ratio > 0.67) & (self.ratio < 1.5)).double().mean())
        direction = float((self.angle_deg < 30).double().mean())
        return f"{low:.2f} {middle:.2f} {high:.2f}; {within:.0%}; {self.sign_right:.0%}; {direction:.0%}; {self.known:.0%}"


def true_motion(truth, t_us, centre_obj):
    """Pose ``[4, 4]`` at a time, and rotation and velocity of the centre there (rad/s, m/s)."""
    step_us = 1_000
    before, now, after = truth.at(torch.tensor([t_us - step_us, t_us, t_us + step_us])).double()
    turned = after[:3, :3] @ before[:3, :3].T
    spin = torch.stack([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]) / 2
    moved = (transform_points(after, centre_obj[None]) - transform_points(before, centre_obj[None]))[0]
    return now, torch.cat([spin, moved]) / (2e-6 * step_us)


def flow_errors(sequence: Path, duration_us: int) -> dict[str, FlowErrors]:
    """Of each model of flow, at the same events of a sequence's first object."""
    session = open_session(RunConfig(source=sequence))
    tracker = Tracker(session.models[:1], session.camera, TrackerConfig(), dtype=torch.float64)
    truth, start_us = session.ground_truth[0], session.start_us
    events = concatenate([chunk for chunk in session.events.chunks() if int(chunk.t_us[0]) < start_us + duration_us])
    maps, samples = first_state(tracker, session.T_cam_obj[:1].double(), torch.tensor([start_us])).maps, {name: [] for name in MODELS}
    for number, end_us in enumerate(range(start_us + WINDOW_US, start_us + duration_us, WINDOW_US)):
        window, t_us, elapsed_us = events.slice_time(end_us - WINDOW_US, end_us), torch.tensor([end_us]), torch.tensor([WINDOW_US])
        seen, burst_age_us = tracker.sensors.window_events(NearbyEvents(window), maps.burst_age_us, t_us, elapsed_us)
        maps = replace(maps, last_event_us=update_last_event(maps.last_event_us, window), burst_age_us=burst_age_us)
        if end_us - start_us > WARM_UP_US and number % EVERY == 0:
            for name, sample in at_truth(tracker, seen, maps, t_us, truth).items():
                samples[name].append(sample)
    joined = {name: [torch.cat(parts) for parts in zip(*of_model, strict=True)] for name, of_model in samples.items()}
    return {name: FlowErrors(ratio[has], angle[has], float(has.double().mean())) for name, (ratio, angle, has) in joined.items()}


def at_truth(tracker, seen, maps, t_us, truth):
    """Of each model: ratio, angle and existence of the flow of the events of a window that are on a contour at the true pose."""
    T_cam_obj, velocity = true_motion(truth, int(t_us), tracker.centre_obj[0])
    state = first_state(tracker, T_cam_obj[None], t_us)
    still = predicted_after(tracker, state, torch.full_like(tracker.diameter_m, 1e-9))
    prediction = replace(still, T_cam_obj=T_cam_obj[None], velocity=velocity[None])
    contours = prediction.objects.contours(prediction.T_cam_obj, tracker.config.contours)
    index = index_contours(contours, tracker.image_size, 4, 1)
    observed = select_events(seen, index, prediction.moving(compensated=True), 4000)
    points = SensorPoints(tracker.sensors.nearest_pixels(observed.pixels), observed.age_s, observed.polarity, observed.mask)
    nearest = index.look_up(prediction.carried(observed.pixels, observed.age_s))
    contour = nearest.clamp(min=0)[0]
    normals, moving, pixels = contours.normals[0, contour], prediction.contour_velocity(contours)[0, contour], contours.pixels[0, contour]
    away_px = ((pixels - observed.pixels[0] - moving * observed.age_s[0, :, None]) * normals).sum(-1).abs()
    speed = (normals * moving).sum(-1)
    chosen = observed.mask[0] & (nearest[0] >= 0) & (away_px < NEAR_PX) & (speed.abs() > LEAST_SPEED_PX_S)
    result, view = {}, tracker.sensors.view(maps, t_us)
    for name, model in MODELS.items():
        flow, has_flow = estimate_flow(points, view, model)
        ratio = (flow[0] * normals).sum(-1) / speed
        cosine = torch.nn.functional.cosine_similarity(flow[0], moving, dim=-1)
        result[name] = ratio[chosen], torch.rad2deg(cosine.clamp(-1, 1).acos())[chosen], has_flow[0][chosen]
    return result
