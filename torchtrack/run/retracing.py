"""Objects that were found again, followed back in time to where they were lost.

Forwards, an object that comes out from behind another is looked for while hardly anything of it is to be seen: it is found late, or
in a wrong place first. Backwards nothing has to be looked for: from the window in which it is seen well again, the events of the
windows before are played in reverse, and a tracker follows them to where the object is hidden. It comes later for it, so this is for
recordings, and for whoever can wait.

In reverse, contours move the other way and what got brighter gets darker, so that all that is known of an object still holds. It is
followed alone: that another tracked object hides it is no more known than of anything else.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.events import EventBatch
from torchtrack.core.lie import difference_about, retract_about
from torchtrack.core.windows import EventWindow
from torchtrack.run.stepping import Step
from torchtrack.tracking.contours.points import Contours, reproject
from torchtrack.tracking.initialization import first_state
from torchtrack.tracking.state import StepResult, TrackerState, take_part
from torchtrack.tracking.tracker import Tracker
from torchtrack.tracking.validation.status import Status

# An object that was lost for longer is hidden, and not followed any farther (s).
_HIDDEN_S = 0.01
# A pose that shows an object this near to where it was seen well forwards is the same (px).
_SAME_PX = 2.0
# By how much more a pose has to explain than one of a window in which the object was not lost yet.
_MARGIN = 0.1
# A share of the time that an object was hidden for, in which it moves on straight.
_SHORT = 1e-4


@dataclass(frozen=True)
class Gap:
    """Where an object was lost, among consecutive steps: their numbers.

    Args:
        first: the first step in which it was lost, or found in another place than was to be expected.
        seen: the step in which it is seen well again.
        farthest: the step that it is followed back to, at most.
    """

    first: int
    seen: int
    farthest: int = 0


def retraced(steps: Sequence[Step], number: int, gap: Gap, alone: Tracker) -> list[Step]:
    """Consecutive steps, with other poses of the object ``number`` in and before a gap, as far as it can be followed back.

    From where it was lost on, what leads there from where it is seen well is believed; before that, what explains clearly more. Where it can't
    be followed, because it is hidden, its poses are interpolated between those before and after that.

    Args:
        steps: without maps of events.
        number: of the object, in the steps.
        gap: where it was lost.
        alone: a tracker of this object alone.
    """
    changed, since_us, earliest = list(steps), steps[gap.seen].window.t_end_us, gap.seen
    back = followed_back(steps[gap.seen].state, number, [step.window for step in steps[gap.farthest + 1 : gap.seen + 1]], alone)
    for at, (state, result) in zip(reversed(range(gap.farthest, gap.seen)), back, strict=True):
        before = steps[at]
        if int(result.status[0]) >= int(Status.LOST):
            if since_us - before.window.t_end_us > 1e6 * _HIDDEN_S:
                break
            continue
        since_us = before.window.t_end_us
        if at < gap.first and not float(before.state.health.time_since_validated_s[number]) and _apart_px(before, number, result, alone) < _SAME_PX:
            break
        if at >= gap.first or float(state.health.score[0]) > float(before.state.health.score[number]) + _MARGIN:
            changed[at], earliest = _with_object(before, number, state, result), at
    first = earliest
    while first and int(changed[first - 1].result.status[number]) >= int(Status.LOST):
        first -= 1
    if 0 < first < earliest:
        changed[first - 1 : earliest + 1] = _interpolated(changed[first - 1 : earliest + 1], number, alone)
    return changed


def _interpolated(steps: Sequence[Step], number: int, alone: Tracker) -> list[Step]:
    """Consecutive steps, with the object's poses in all but the first and the last interpolated: a cubic with poses and velocities of these two.

    Nothing was seen of it there: it stays lost, and as uncertain as it was. A prediction from the first of them comes to rest; a straight
    way was up to 25 degrees off where this one was 12, on a scene with a bar.
    """
    own, centre = slice(number, number + 1), alone.centre_obj.double()
    T_begin, T_end = (step.state.T_cam_obj[own] for step in (steps[0], steps[-1]))
    t_s = 1e-6 * torch.tensor([step.window.t_end_us - steps[0].window.t_end_us for step in steps], dtype=torch.float64, device=centre.device)
    leaving, arriving = (t_s[-1] * step.state.velocity[own].double() for step in (steps[0], steps[-1]))
    way = difference_about(T_begin, T_end, centre)
    # In coordinates about where it begins.
    arriving = (difference_about(T_begin, retract_about(T_end, _SHORT * arriving, centre), centre) - way) / _SHORT
    s = (t_s[1:-1] / t_s[-1])[:, None]
    offsets = s * (1 - s) ** 2 * leaving + s**2 * (3 - 2 * s) * way + s**2 * (s - 1) * arriving
    T_between = retract_about(T_begin.expand(len(s), 4, 4), offsets, centre)
    velocity = difference_about(torch.cat([T_begin, T_between[:-1]]), T_between, centre) / t_s.diff()[:-1, None]
    between = zip(steps[1:-1], T_between.split(1), velocity.split(1), strict=True)
    return [steps[0], *(_with_pose(step, number, T, v.to(alone.intrinsics.dtype), alone) for step, T, v in between), steps[-1]]


def _with_pose(step: Step, number: int, T_cam_obj: Float[Tensor, "1 4 4"], velocity: Float[Tensor, "1 6"], alone: Tracker) -> Step:
    """The step with the object in another place, of which nothing was seen."""
    motion, result = step.state.motion, step.result
    motion = replace(motion, T_cam_obj=_row(motion.T_cam_obj, number, T_cam_obj), velocity=_row(motion.velocity, number, velocity))
    contours = result.contours.rows(torch.tensor([number], device=velocity.device))
    contours = _with_contours(result.contours, number, reproject(contours, T_cam_obj.to(velocity.dtype), alone.intrinsics))
    return replace(step, state=replace(step.state, motion=motion), result=replace(result, T_cam_obj=motion.T_cam_obj, contours=contours))


def followed_back(state: TrackerState, number: int, windows: Sequence[EventWindow], alone: Tracker) -> Iterator[tuple[TrackerState, StepResult]]:
    """The states and results of an object at the start of each window, the latest first, from what is known at the end of the last one.

    Args:
        state: then.
        number: of the object, in it.
        windows: one after the other.
        alone: a tracker of this object alone.
    """
    state = _turned_back(state, number, alone)
    for window in reversed(windows):
        about_us = windows[-1].t_end_us
        events = in_reverse(window, about_us).to(state.T_cam_obj.device)
        state, result = alone.step(state, events, 2 * about_us - window.t_start_us)
        yield state, result


def in_reverse(window: EventWindow, about_us: int) -> EventBatch:
    """The events of a window with time running backwards, mirrored at ``about_us``: its start is their end."""
    events = window.events
    x, y, t_us, polarity, stream = (values.flip(0) for values in (events.x, events.y, events.t_us, events.polarity, events.stream_index))
    # Events at the end of a window belong to it, and those at its start do not.
    return EventBatch(x, y, 2 * about_us + 1 - t_us, ~polarity, stream)


def _turned_back(state: TrackerState, number: int, alone: Tracker) -> TrackerState:
    """What is known of one object, as the state of a tracker of it alone for which time runs backwards."""
    known = take_part(state, slice(number, number + 1), slice(0, 1))
    fresh = first_state(alone, known.T_cam_obj, known.t_us)
    return replace(
        known,
        motion=replace(known.motion, velocity=-known.motion.velocity, covariance=_of_reverse(known.motion.covariance)),
        health=replace(
            known.health,
            drift_s=fresh.health.drift_s,
            T_last_validated=fresh.health.T_last_validated,
            time_since_validated_s=fresh.health.time_since_validated_s,
        ),
        maps=fresh.maps,
    )


def _of_reverse(covariance: Float[Tensor, "b 12 12"]) -> Float[Tensor, "b 12 12"]:
    """The covariance of pose and velocity, with the velocity the other way."""
    sign = torch.ones_like(covariance[0, 0])
    sign[6:] = -1
    return covariance * sign * sign[:, None]


def _apart_px(step: Step, number: int, result: StepResult, alone: Tracker) -> float:
    """How far apart two poses of an object show its contours, in the mean over them (px)."""
    contours = result.contours
    T_cam_obj = step.result.T_cam_obj[number : number + 1].to(contours.pixels.dtype)
    way_px = (reproject(contours, T_cam_obj, alone.intrinsics).pixels - contours.pixels).norm(dim=-1)
    return float((way_px * contours.mask).sum() / contours.mask.sum().clamp(min=1))


def _with_object(step: Step, number: int, state: TrackerState, result: StepResult) -> Step:
    """The step with another state and result of one object, for which time runs backwards."""
    before, forward = step.state, step.result
    motion = replace(
        before.motion,
        T_cam_obj=_row(before.motion.T_cam_obj, number, state.motion.T_cam_obj),
        velocity=_row(before.motion.velocity, number, -state.motion.velocity),
        covariance=_row(before.motion.covariance, number, _of_reverse(state.motion.covariance)),
    )
    health = replace(before.health, score=_row(before.health.score, number, state.health.score))
    state = replace(before, motion=motion, health=health)
    result = replace(
        forward,
        T_cam_obj=_row(forward.T_cam_obj, number, result.T_cam_obj),
        covariance=_row(forward.covariance, number, result.covariance),
        status=_row(forward.status, number, result.status),
        quality=_row(forward.quality, number, result.quality),
        contours=_with_contours(forward.contours, number, result.contours),
        observation_count=_row(forward.observation_count, number, result.observation_count),
    )
    return replace(step, state=state, result=result)


def _with_contours(all_of_them: Contours, number: int, of_one: Contours) -> Contours:
    """Contours, with those of one object in the place of its own."""
    count = max(all_of_them.mask.shape[1], of_one.mask.shape[1])
    before, other = all_of_them.widened(count), of_one.widened(count)
    return Contours(*(_row(value, number, getattr(other, name)) for name, value in vars(before).items()))


def _row(values: Tensor, number: int, row: Tensor) -> Tensor:
    """The values with one row in the place of another."""
    changed = values.clone()
    changed[number : number + 1] = row
    return changed
