"""Objects that were lost for long, searched for everywhere: the search for a first pose, a part of it in each window.

Relocalization looks around where an object was last seen, and takes what lies within some 60° of that. What was out of the image, or behind
something, for longer comes back at any pose. So the events that nothing else explains are searched as a recording is at its start
(:mod:`torchtrack.run.searches_everywhere`), beside the tracker: a window takes one part of it, and the tracker knows nothing of it until a
pose has been followed from the search's beginning up to now, and explains as much all the way as the object did when it was seen well.

With ``relocalization.answer_after_us``, no window takes a part: the search goes on in a thread of its own.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.camera import Camera, undistortion_table
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.core.later import Ahead
from torchtrack.core.windows import EventWindow
from torchtrack.errors import EventDataError, PoseError
from torchtrack.io.keep_up import HastyWindow
from torchtrack.object_model import ObjectModel
from torchtrack.run.first_pose.parts import Parts
from torchtrack.run.first_pose.searching import projected_box
from torchtrack.run.first_pose.start import Box, Start, box_of_events
from torchtrack.run.first_pose.tracked import FOLLOWED_US
from torchtrack.run.searches_everywhere import Candidate, SearchEverywhere, SearchInParts, SearchInThread, candidate_in_box
from torchtrack.tracking.relocalization.schedule import is_time
from torchtrack.tracking.state import TrackerState
from torchtrack.tracking.tracker import Tracker

# How often it is looked whether there is something to search for (µs), and after a search that failed, how long until the next (µs): twice as
# long each time, up to the last.
_LOOK_US, _FIRST_WAIT_US, _LONGEST_WAIT_US = 50_000, 200_000, 5_000_000
# An object that was lost is back once it was seen well for so long (µs).
_BACK_US = 300_000
# A box is made around the events of so long (µs): of more, it would be that of the object's way. Of fewer than these no object is seen.
_BOX_US, _FEWEST_EVENTS = 20_000, 300
# An object that is still coming into the image would be taken for a smaller one: its box has to be so far from the border (px).
_FROM_BORDER_PX = 4.0
# Around an object that is seen well, events within so much more than its box are its own.
_ITS_OWN = 0.1
# What explains less is no object, however little of it was ever seen.
_LEAST_EXPLAINED = 0.5
# In a thread, it has so many times as long as a search around the last place: it takes 20 to 110 parts, of 10 to 20 ms each as a rule.
_TIMES_AS_LONG = 20


class LostSearch:
    """Searches for the lost objects of one stream, one at a time.

    Args:
        tracker: of the stream, and maybe others.
        stream: which one of it.

    Attributes:
        windows: after how many a search has gone on.
    """

    def __init__(self, tracker: Tracker, stream: int = 0) -> None:
        numbers = (tracker.stream_index == stream).nonzero()[:, 0].tolist()
        self._models: Sequence[ObjectModel] = [tracker.object_models[number] for number in numbers]
        self._camera: Camera = tracker.cameras[stream]
        search = tracker.config.relocalization
        self._after_us = search.everywhere_after_us if tracker.config.searches else 0
        self._accept_ratio = search.accept_ratio
        self._table: Float[Tensor, "h w 2"] | None = None
        self._windows: deque[EventWindow] = deque()
        self._searched: int | None = None
        self._search: SearchEverywhere | None = None
        self._ahead, self._ends_after_us = Ahead(), _TIMES_AS_LONG * search.answer_after_us
        # Since when each object is lost, and since when it is seen well; those that are not have no entry (µs).
        self._lost_us: dict[int, int] = {}
        self._well_us: dict[int, int] = {}
        # Of each object, when it may be searched for again, and how long to wait after that (µs).
        self._waits: dict[int, tuple[int, int]] = {}
        self.windows = 0

    def after(self, window: EventWindow, state: TrackerState) -> TrackerState:
        """The state after a window, with the object in it that a search has found by now; the same one where there is none.

        Args:
            window: that was taken.
            state: of the stream's objects, after it.
        """
        if not self._after_us:
            return state
        self._hold(window)
        if isinstance(window, HastyWindow):
            return state
        if bool(is_time(torch.tensor([window.t_start_us]), torch.tensor([window.t_end_us]), _LOOK_US)):
            self._look(state, window.t_end_us)
            if self._search is None:
                self._begin(state, window.t_end_us)
        return state if self._search is None else self._advanced(self._search, state, window)

    def _hold(self, window: EventWindow) -> None:
        """Keep the window, and those that a search needs that may begin.

        What was seen before a gap is over; and where a live stream is behind there is no time to search.
        """
        if window.after_gap or isinstance(window, HastyWindow):
            self._windows.clear()
            if self._search is not None:
                self._search.drop()
            self._search = None
        self._windows.append(window)
        while len(self._windows) > 1 and self._windows[0].t_start_us < window.t_end_us - FOLLOWED_US:
            self._windows.popleft()

    def _begin(self, state: TrackerState, now_us: int) -> None:
        """Begin a search for what is lost the longest, if there is such an object and what may be events of it."""
        number = self._longest_lost(now_us)
        if number is None:
            return
        try:
            start = self._start(number, self._seen_well(state))
            count = int(torch.searchsorted(start.events.t_us, start.at_us + _BOX_US, right=True))
            box = box_of_events(start, count) if count >= _FEWEST_EVENTS else None
        except (EventDataError, PoseError):
            # Events are scattered all over: nothing comes back. Or one of the others is partly behind the camera.
            return
        if box is not None and self._is_inside(box):
            wanted = max(self._accept_ratio * float(state.health.reference_explained_ratio[number]), _LEAST_EXPLAINED)
            self._searched, self._search = number, self._under_way(candidate_in_box(start, box, wanted), now_us)

    def _under_way(self, candidate: Parts[Candidate | None], now_us: int) -> SearchEverywhere:
        if not self._ends_after_us:
            return SearchInParts(candidate, self._windows)
        return SearchInThread(candidate, self._windows, now_us + self._ends_after_us, self._ahead)

    def _longest_lost(self, now_us: int) -> int | None:
        due = [number for number, since_us in self._lost_us.items() if now_us >= max(since_us + self._after_us, self._waits.get(number, (0, 0))[0])]
        return min(due, key=lambda number: self._lost_us[number], default=None)

    def _look(self, state: TrackerState, now_us: int) -> None:
        """Note since when objects are lost.

        One that is seen well again has not come back yet: while hardly anything is known of it, much fits by chance for some windows.
        """
        unseen_us = (1e6 * state.health.time_since_validated_s).long().tolist()
        seen_once = (state.health.mean_score > 0).tolist()
        for number, (us, once) in enumerate(zip(unseen_us, seen_once, strict=True)):
            if us >= _LOOK_US:
                self._well_us.pop(number, None)
                if once:
                    self._lost_us.setdefault(number, now_us - us)
            elif now_us - self._well_us.setdefault(number, now_us) >= _BACK_US:
                self._lost_us.pop(number, None)

    def _seen_well(self, state: TrackerState) -> list[tuple[ObjectModel, Float[Tensor, "4 4"]]]:
        """The objects whose events are known to be theirs."""
        poses = state.T_cam_obj.cpu()
        return [(model, poses[number]) for number, model in enumerate(self._models) if number not in self._lost_us]

    def _start(self, number: int, seen_well: Sequence[tuple[ObjectModel, Float[Tensor, "4 4"]]]) -> Start:
        """An object before the events that are held, but for those of the others."""
        events = concatenate([window.events for window in self._windows]).to("cpu")
        start = Start(self._models[number], self._camera, events, self._pixels(events), self._windows[0].t_start_us)
        free = torch.ones(len(events), dtype=torch.bool)
        for model, T_cam_obj in seen_well:
            free &= ~projected_box(replace(start, model=model), T_cam_obj).grown(_ITS_OWN).holds(start.pixels)
        return replace(start, events=events[free], pixels=start.pixels[free])

    def _pixels(self, events: EventBatch) -> Float[Tensor, "e 2"]:
        if self._table is None:
            self._table = undistortion_table(self._camera)
        return self._table[events.y.long(), events.x.long()]

    def _is_inside(self, box: Box) -> bool:
        low, far = min(box.u0, box.v0), max(box.u1 - self._camera.width, box.v1 - self._camera.height)
        return low >= _FROM_BORDER_PX and far <= -_FROM_BORDER_PX

    def _advanced(self, search: SearchEverywhere, state: TrackerState, window: EventWindow) -> TrackerState:
        """The state after a window that a search goes on after."""
        self.windows += 1
        ended = search.after(window)
        if ended is None:
            return state
        number, self._search = self._searched or 0, None
        if number not in self._lost_us:
            return state
        if ended.own is not None:
            self._waits.pop(number, None)
            self._lost_us.pop(number)
            return with_object(state, number, ended.own)
        wait_us = self._waits.get(number, (0, _FIRST_WAIT_US))[1]
        self._waits[number] = window.t_end_us + wait_us, min(2 * wait_us, _LONGEST_WAIT_US)
        return state


def with_object(state: TrackerState, number: int, own: TrackerState) -> TrackerState:
    """The state with an object where another state, of it alone, has it; it counts as seen well there."""

    def put(values: Tensor, value: Tensor) -> Tensor:
        changed = values.clone()
        changed[number] = value[0].to(values)
        return changed

    health, zero = state.health, torch.zeros(1)
    motion = {name: put(getattr(state.motion, name), value) for name, value in vars(own.motion).items()}
    return replace(
        state,
        motion=replace(state.motion, **motion),
        health=replace(
            health,
            score=put(health.score, own.health.score),
            mean_score=put(health.mean_score, own.health.mean_score),
            drift_s=put(health.drift_s, zero),
            T_last_validated=put(health.T_last_validated, own.T_cam_obj),
            time_since_validated_s=put(health.time_since_validated_s, zero),
        ),
    )
