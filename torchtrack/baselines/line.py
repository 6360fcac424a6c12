"""``line``: events against projected model lines in a Kalman filter, after Chamorro, Andrade-Cetto and Solà.

"High-speed event camera tracking" (BMVC 2020) and "Event-based line SLAM in real time" (RA-L 2022): lines of a known
map are projected at the predicted pose, each event is associated with the line that it lies near, unless a second line
is near too, and its distance from the line corrects an error-state Kalman filter on the Lie group, whose motion model
is a constant velocity. Here the lines are the model's straight edges.

Where we depart: they correct the filter event by event, many thousand times a second. We correct it once a window, with
all of its events at once and iterated, each moved from its own time to the window's end with the predicted velocity of
its line: to first order the same, and it runs on the package's one solver, which takes the prediction as a prior. Their
test of each innovation is here the gate, and a robust loss.
"""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.baselines.event_lines import EventLineTracker
from torchtrack.core.linalg import solve_positive
from torchtrack.tracking.estimation.terms import Linearisation
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.step import StepInput

# Deviation of the distance between an event and its line (px): much is common to the events of a line, so it is not small.
_EVENT_PX = 4.0
# Spectral density of the accelerations that the constant velocity does not foresee, (rad/s²)² s and (m/s²)² s.
_TURNING, _MOVING = 1000.0, 10.0
# Deviations at the start: pose (rad, m) and velocity (rad/s, m/s).
_FIRST_DEVIATIONS = (0.01, 0.005, 3.0, 0.5)
# Events with a second line as near as this are of either (px).
_APART_PX = 3.0


class LineTracker(EventLineTracker):
    """An error-state Kalman filter on pose and velocity, corrected with the distances of events from model lines."""

    def init(self, T_cam_obj: Any, t_us: int | Int[Tensor, "s"]) -> TrackerState:
        """The state before the first window; see :meth:`torchtrack.tracking.tracker.Tracker.init`."""
        state = super().init(T_cam_obj, t_us)
        deviations = torch.tensor(_FIRST_DEVIATIONS, dtype=torch.float64, device=state.T_cam_obj.device).repeat_interleave(3)
        covariance = torch.diag(deviations.square()).repeat(len(state.T_cam_obj), 1, 1)
        return replace(state, motion=replace(state.motion, covariance=covariance))

    def _tracked(self, state: TrackerState, given: StepInput) -> tuple[TrackerState, StepResult]:
        events = given.events.events
        window = self._open(state, events, given.t_us, state.velocity)
        predicted = predicted_covariance(state.motion.covariance, window.duration_s.double())
        eye = torch.eye(6, dtype=predicted.dtype, device=predicted.device).expand(len(predicted), 6, 6)
        information = solve_positive(predicted[:, :6, :6], eye)[0]
        fit = self._solve_rounds(window, events, information.to(state.velocity.dtype), _EVENT_PX**-2, _APART_PX, given.extra_terms)
        judged = self._judge(window, fit)
        taken = judged.is_taken
        correction, covariance = corrected(predicted, information, fit.solution)
        velocity = window.velocity + torch.where(taken[:, None], correction, 0).to(window.velocity.dtype)
        kept = torch.where(taken[:, None, None], covariance, predicted)
        next_state, result = self._close(state, window, fit, judged, velocity, kept[:, :6, :6])
        return replace(next_state, motion=replace(next_state.motion, covariance=kept)), result


def predicted_covariance(covariance: Float[Tensor, "b 12 12"], duration_s: Float[Tensor, "b"]) -> Float[Tensor, "b 12 12"]:
    """Covariance after ``duration_s`` of a constant velocity with white accelerations."""
    eye = torch.eye(6, dtype=covariance.dtype, device=covariance.device)
    carry = torch.eye(12, dtype=covariance.dtype, device=covariance.device).repeat(len(covariance), 1, 1)
    carry[:, :6, 6:] = eye * duration_s[:, None, None]
    density = torch.diag(covariance.new_tensor([_TURNING] * 3 + [_MOVING] * 3))
    time = duration_s[:, None, None]
    noise = torch.cat([torch.cat([time**3 / 3 * density, time**2 / 2 * density], -1), torch.cat([time**2 / 2 * density, time * density], -1)], -2)
    return carry @ covariance @ carry.transpose(1, 2) + noise


def corrected(
    predicted: Float[Tensor, "b 12 12"], information: Float[Tensor, "b 6 6"], solution: Linearisation
) -> tuple[Float[Tensor, "b 6"], Float[Tensor, "b 12 12"]]:
    """Correction of the velocity (rad/s, m/s) and the covariance, once the solver has found the pose.

    The solver's Hessian is the information of prediction and events; what it moved the pose by moves the velocity as far
    as their errors go together.
    """
    pose_before, together = predicted[:, :6, :6], predicted[:, 6:, :6]
    eye = torch.eye(6, dtype=predicted.dtype, device=predicted.device).expand(len(predicted), 6, 6)
    pose_after, known = solve_positive(solution.hessian.double(), eye)
    pose_after = torch.where(known[:, None, None], pose_after, pose_before)
    gain = together @ information
    across = gain @ pose_after
    velocity_after = predicted[:, 6:, 6:] - gain @ (pose_before - pose_after) @ gain.transpose(1, 2)
    covariance = torch.cat([torch.cat([pose_after, across.transpose(1, 2)], -1), torch.cat([across, velocity_after], -1)], -2)
    correction = (gain @ solution.from_prior.double()[..., None])[..., 0]
    return correction, 0.5 * (covariance + covariance.transpose(1, 2))
