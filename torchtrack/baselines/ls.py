"""``ls``: least squares of the distances between events and projected model lines, the paper's second comparison method."""

import torch

from torchtrack.baselines.event_lines import EventLineTracker
from torchtrack.core import lie
from torchtrack.core.linalg import inverse
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.step import StepInput

# Share of a new window in the velocity.
_VELOCITY_GAIN = 0.6


class LeastSquaresTracker(EventLineTracker):
    """Every event near a projected line draws it, all alike: no robust loss, no prior, no doubt which line an event is of.

    The paper says of it that it "optimizes the pose and tracks the object by minimizing the distance between events and
    lines", and nothing else. To be as good as that allows, the last motion is carried on, events are moved to the
    window's end with the line's own velocity, and the gate around the lines narrows from round to round.
    """

    def _tracked(self, state: TrackerState, given: StepInput) -> tuple[TrackerState, StepResult]:
        events = given.events.events
        window = self._open(state, events, given.t_us, state.velocity)
        nothing = torch.zeros(len(state.velocity), 6, 6, dtype=state.velocity.dtype, device=state.velocity.device)
        fit = self._solve_rounds(window, events, nothing, weight=1.0, apart_px=0.0, extra_terms=given.extra_terms)
        judged = self._judge(window, fit)
        moved = lie.small_difference_about(state.T_cam_obj, fit.solution.T_cam_obj.double(), self.centre_obj.double()).to(state.velocity.dtype)
        mixed = torch.lerp(state.velocity, moved / window.duration_s.clamp(min=1e-6)[:, None], _VELOCITY_GAIN)
        # A pose that was not taken says nothing of the motion: it is not carried on for long.
        velocity = torch.where(judged.is_taken[:, None], mixed, 0.5 * state.velocity)
        return self._close(state, window, fit, judged, velocity, inverse(fit.solution.hessian.double()))
