"""One mending of time for every stream of events: what is late is sorted in, what was sent twice is dropped, clocks go on.

Events of a sound stream pass through untouched. Otherwise, by how far an event lies before the newest one:

- up to :data:`REORDER_US`: it came late, and is sorted in; where an equal one is there already, it was sent twice;
- more, and the stream soon leaps back to where it was: it came too late, or was sent twice, and is left out;
- more, and the stream stays there: the clock was set back. From there on times are shifted, so that time goes on: by
  2^31 or 2^32 µs where a counter of so many bits began again, else so that the next event comes 1 µs after the newest one.

A few events far ahead of all others are wild, and are left out. A leap forward that lasts is a gap, and stays one.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError
from torchtrack.io.columns import Columns, join, parted, shifted
from torchtrack.io.lateness import Arrivals, Recent, merged
from torchtrack.io.problems import ClockChange, Problem, Problems
from torchtrack.io.soundness import in_order, inside

# Packets of USB cameras and networks come 1 to 5 ms late; contours of fast objects move by a few pixels in this time.
REORDER_US = 10_000
# So many events apart from all others are wild; of more, the clock may be another.
_FEW = 16
# A stream that stays in the past for so long has another clock; a packet that was held up is shorter.
_LASTING_US, _LASTING_EVENTS = 50_000, 1 << 17
# A return to where the stream was: a step longer than this, and than so many usual ones.
_LEAP_US, _LEAP_STEPS = 1_000, 20
# Counters of µs that begin again, and how long may have passed meanwhile.
_COUNTERS = (1 << 31, 1 << 32)
_WRAP_SLACK_US = 10_000_000
# Where times stand still, no more than this is waited for.
_MOST_HELD = 1 << 21
# Where times are compared, sums and differences of them fit 64 bits.
_LARGEST_US = 1 << 61
# Disorder is looked at in blocks; where time goes far back more than once in so many events, each event is judged by itself.
_BLOCK, _EVENTS_A_RETURN = 4096, 256


class Mender:
    """Mends one pass through a stream.

    Args:
        problems: where faults are counted; if strict, the first one is an error.
        waits: whether events are held back from the start until none within :data:`REORDER_US` can come before them;
            otherwise, for live streams, once some came late and for as long as they were.
        counter_bits: of a clock that is known to begin again, which is no fault.
    """

    def __init__(self, problems: Problems, *, waits: bool, counter_bits: int | None = None) -> None:
        self._problems, self._counter = problems, None if counter_bits is None else 1 << counter_bits
        self._hold_us = REORDER_US if waits else 0
        # Added to what the clock shows.
        self._shift_us = 0
        # Sorted, and not given on yet; then what lies in the past of it, until it is known why.
        self._held: list[Columns] = []
        self._apart = Columns.empty()
        self._recent = Recent()
        self._newest_us: int | None = None
        # How many of the newest events may be wild; number of the next event; returns to the past in this part.
        self._doubtful = self._at = self._returns = 0

    def add(self, part: Columns) -> list[Columns]:
        """Take the next events; returns those that are in order for sure.

        Raises:
            EventDataError: if time goes back, and faults are errors.
        """
        self._take(self._shifted(part) if self._shift_us and len(part) else part)
        return self._released(at_end=False)

    def rest(self) -> list[Columns]:
        """What is held back, when no more comes."""
        apart, self._apart = self._apart, Columns.empty()
        self._at -= len(apart)
        self._put_in(apart, at_end=True)
        return self._released(at_end=True)

    def _shifted(self, events: Columns) -> Columns:
        return replace(events, t_us=shifted(self._sound_times(events), self._shift_us))

    def _take(self, part: Columns) -> None:
        if len(part) == 0:
            return
        if len(self._apart) == 0 and in_order(part.t_us, self._newest_us):
            self._append(part)
            self._at += len(part)
            return
        apart, self._apart = self._apart, Columns.empty()
        self._at -= len(apart)
        part = replace(part, t_us=self._sound_times(part))
        self._put_in(join([apart, part]) if len(apart) else part)

    def _sound_times(self, events: Columns) -> np.ndarray:
        """The times as int64, far enough from its ends."""
        for time_us in (int(events.t_us.min()), int(events.t_us.max())):
            if abs(time_us) > _LARGEST_US:
                raise EventDataError(f"{self._problems.source}: a time of {time_us} µs makes no sense. Check the file's times and their unit.")
        return events.t_us.astype(np.int64)

    def _append(self, events: Columns) -> None:
        self._held.append(events)
        self._newest_us = int(events.t_us[-1])

    def _put_in(self, events: Columns, *, at_end: bool = False) -> None:
        """Events in any order: those up to where time goes back too far, then what comes of that, and so on."""
        self._returns = max(self._returns - len(events) // _EVENTS_A_RETURN - 1, 0)
        while len(events):
            if self._returns > _BLOCK // _EVENTS_A_RETURN + len(events) // _EVENTS_A_RETURN:
                events = self._without_disorder(events)
            block = events[:_BLOCK]
            far_back = self._far_back(block)
            at = int(np.argmax(far_back)) if far_back.any() else len(block)
            if at:
                self._sort_in(events[:at])
                events, self._at = events[at:], self._at + at
                continue
            left = self._gone_back(events, at_end=at_end)
            if left is None:
                self._apart, self._at = events, self._at + len(events)
                return
            events = left

    def _far_back(self, events: Columns) -> np.ndarray:
        newest_us = int(events.t_us[0]) if self._newest_us is None else self._newest_us
        return np.asarray(events.t_us < Arrivals(events.t_us, newest_us).newest_before - REORDER_US)

    def _without_disorder(self, events: Columns) -> Columns:
        """Events less those that are late for what came before, or early for what comes after: whichever are fewer."""
        usable = events.t_us >= (self._newest_us if self._newest_us is not None else events.t_us.min()) - REORDER_US
        late = events.t_us < np.maximum.accumulate(events.t_us) - REORDER_US
        early = events.t_us > np.minimum.accumulate(np.where(usable, events.t_us, events.t_us.max())[::-1])[::-1] + REORDER_US
        kept = usable & ~(early if early.sum() <= late.sum() else late)
        self._problems.record(Problem.BACK, int((~kept).sum()), f"times are in no order from event {self._at} on. Sort the events by time.")
        return events[kept]

    def _sort_in(self, events: Columns) -> None:
        """Events that are late by no more than may be mended."""
        if in_order(events.t_us, self._newest_us):
            self._append(events)
            return
        arrivals = Arrivals(events.t_us, self._newest_us if self._newest_us is not None else int(events.t_us[0]))
        before, after = arrivals.first_step_back
        detail = f"time goes back from {before} to {after} µs at event {self._at + arrivals.first_late}. Sort the events by time."
        whole, overlapping = parted(self._held, int(events.t_us.min()))
        events, repeated, too_late, late = merged(overlapping, events, arrivals, self._recent)
        self._problems.record(Problem.REPEATED, repeated, f"{detail} These were there already: a packet was sent twice.")
        self._problems.record(Problem.BACK, too_late, detail)
        self._problems.record(Problem.SORTED, late, detail)
        if too_late:
            self._hold_us = min(max(self._hold_us, 2 * arrivals.latest_by), REORDER_US)
        self._held = whole
        if len(events):
            self._append(events)

    def _gone_back(self, events: Columns, *, at_end: bool) -> Columns | None:
        """What is left of events that begin too far in the past, once it is told why; None while that is not known yet."""
        newest_us, back_us = self._newest_us if self._newest_us is not None else 0, int(events.t_us[0])
        detail = f"time goes back from {newest_us} to {back_us} µs at event {self._at}"
        self._returns += 1
        wild = self._wild(back_us)
        if wild and (len(events) > wild or at_end):
            self._drop_newest(wild)
            self._problems.record(Problem.WILD, wild, f"{detail}; what came just before is wild. Leave it out.")
            return events
        if wild:
            return None
        end, leaps = _return(events.t_us, newest_us)
        past = events[:end]
        known = self._recent.knows(past[:256], self._held)
        if len(known) and known.mean() > 0.9:
            self._problems.record(Problem.REPEATED, end, f"{detail}: what comes then was there already. Send each packet once.")
        elif self._wrap(back_us) and (end > _FEW or at_end):
            return self._with_new_clock(events, back_us, detail)
        elif leaps or (at_end and not self._lasts(past, REORDER_US)):
            self._problems.record(Problem.BACK, end, f"{detail} for {end} events. Sort the events by time.")
        elif end < len(events) or at_end or self._lasts(past, _LASTING_US):
            return self._with_new_clock(events, back_us, detail)
        else:
            return None
        self._at += end
        return events[end:]

    def _lasts(self, past: Columns, span_us: int) -> bool:
        return len(past) >= _LASTING_EVENTS or (len(past) > _FEW and int(past.t_us.max()) - int(past.t_us[0]) >= span_us)

    def _wrap(self, back_us: int) -> int:
        """What to add where a counter began again; 0 where none did."""
        newest_us = self._newest_us or 0
        if self._counter and newest_us - back_us >= self._counter // 2:
            return self._counter * -(-(newest_us - back_us - REORDER_US) // self._counter)
        return next((full for full in _COUNTERS if -REORDER_US <= back_us + full - newest_us <= _WRAP_SLACK_US), 0)

    def _with_new_clock(self, events: Columns, back_us: int, detail: str) -> Columns:
        newest_us, wrap = self._newest_us or 0, self._wrap(back_us)
        if newest_us > _LARGEST_US:
            raise EventDataError(f"{self._problems.source}: a time of {newest_us} µs makes no sense. Check the file's times and their unit.")
        more = wrap or newest_us + 1 - back_us
        if wrap and wrap != self._counter:
            bits = wrap.bit_length() - 1
            advice = f"a counter of {bits} bits began again. Add 2^{bits} to the times from there on, or read it without strict, which does so."
            self._problems.record(Problem.WRAPPED, 1, f"{detail}: {advice}")
        elif not wrap:
            advice = (
                "the clock was set back, or another recording begins. Split the stream there, or read it without strict, which goes on from there."
            )
            self._problems.record(Problem.RESET, 1, f"{detail} and stays there: {advice}")
        if wrap != self._counter:
            shown = newest_us - self._shift_us, back_us - self._shift_us
            self._problems.clock_changed(ClockChange("wrap" if wrap else "reset", back_us + more, *shown))
        self._shift_us += more
        return replace(events, t_us=shifted(events.t_us, more))

    def _wild(self, back_us: int) -> int:
        """How many of the newest events are wild, if the stream goes on at ``back_us``; 0 if they are too many, or not apart."""
        times = self._newest_times(_FEW + 1)
        # What goes on there may itself be late by what is sorted in.
        ahead = int((times > back_us + REORDER_US).sum())
        if not 0 < ahead <= _FEW:
            return 0
        before = times[-ahead - 1] if ahead < len(times) else self._recent.newest_us
        if before is None:
            return 0 if self._wrap(back_us) else ahead
        return ahead if times[-ahead] - before > REORDER_US else 0

    def _newest_times(self, count: int) -> np.ndarray:
        """The newest of the times that are held, ascending."""
        pieces: list[np.ndarray] = []
        for piece in reversed(self._held):
            pieces.insert(0, piece.t_us[-count:].astype(np.int64))
            if sum(map(len, pieces)) >= count:
                break
        return np.concatenate(pieces)[-count:] if pieces else np.zeros(0, np.int64)

    def _drop_newest(self, count: int) -> None:
        while count:
            piece = self._held.pop()
            kept = piece[: max(len(piece) - count, 0)]
            count -= len(piece) - len(kept)
            if len(kept):
                self._held.append(kept)
        self._newest_us = int(self._held[-1].t_us[-1]) if self._held else self._recent.newest_us

    def _released(self, *, at_end: bool) -> list[Columns]:
        """The pieces that nothing will come before."""
        if not self._held:
            return []
        due = len(self._held)
        if not at_end:
            self._part_doubtful()
            sure = self._held[-1] if self._doubtful == 0 else self._held[-2] if len(self._held) > 1 else None
            until_us = -(1 << 62) if sure is None else int(sure.t_us[-1]) - self._hold_us
            due = next((number for number, piece in enumerate(self._held) if piece.t_us[-1] > until_us), due)
            due = min(due, len(self._held) - (self._doubtful > 0))
            held = sum(map(len, self._held[due:]))
            while held > _MOST_HELD and due < len(self._held) - 1:
                held, due = held - len(self._held[due]), due + 1
        given, self._held = self._held[:due], self._held[due:]
        self._recent.add(given)
        return given

    def _part_doubtful(self) -> None:
        """Make a piece of its own of the newest events, where they are few and far ahead: they may be wild."""
        newest = self._held[-1]
        self._doubtful = 0
        if len(newest) > _FEW and int(newest.t_us[-1]) - int(newest.t_us[-_FEW - 1]) <= REORDER_US:
            return
        times = self._newest_times(_FEW + 1)
        if len(times) <= _FEW and self._recent.newest_us is not None:
            times = np.concatenate([[self._recent.newest_us], times])
        leaps = np.flatnonzero(np.diff(times) > REORDER_US)
        if len(leaps) == 0:
            return
        self._doubtful = len(times) - 1 - int(leaps[0])
        tail, left = join(self._held), sum(map(len, self._held)) - self._doubtful
        self._held = [piece for piece in (tail[:left], tail[left:]) if len(piece)]


def _return(t_us: np.ndarray, newest_us: int) -> tuple[int, bool]:
    """How many of the times stay in the past of ``newest_us``, and whether the stream then leaps back to where it was."""
    if len(t_us) > _BLOCK:
        end, leaps = _return(t_us[:_BLOCK], newest_us)
        if end < _BLOCK:
            return end, leaps
    leaps_near = (t_us[1:] >= newest_us - REORDER_US) & (np.diff(t_us) > REORDER_US)
    reached = np.flatnonzero((t_us[1:] >= newest_us) | leaps_near) + 1
    end = int(reached[0]) if len(reached) else len(t_us)
    far_back = np.flatnonzero(t_us[:end] < np.maximum.accumulate(t_us[:end]) - REORDER_US)
    if len(far_back):
        return int(far_back[0]), True
    if not len(reached):
        return end, False
    usual = (int(t_us[end - 1]) - int(t_us[0])) / end
    return end, int(t_us[end]) - int(t_us[end - 1]) > max(_LEAP_US, _LEAP_STEPS * usual)


def mended_batches(batches: Iterable[EventBatch], width: int, height: int, problems: Problems) -> Iterator[EventBatch]:
    """Batches from anywhere, mended as those of a live source; what was wrong is told at the end."""
    mender, count = Mender(problems, waits=False), 0
    for batch in batches:
        events = inside(Columns.from_batch(batch.to("cpu")), width, height, problems, count)
        count += len(batch)
        yield from (piece.batch() for piece in mender.add(events))
    yield from (piece.batch() for piece in mender.rest())
    problems.warn()
