"""The clock of a camera against that of ROS: a packet says when it was received, its events when they happened by the camera's clock."""

from collections import deque

# A packet may be late, and none is early: the least difference of the last packets is the best guess, and follows a clock that drifts.
_PACKETS = 500
# A difference that changes by so much is of another clock, as after a restart of the camera (µs).
_OTHER_CLOCK_US = 1_000_000


class PacketClock:
    """Learns how far the two clocks are apart; not for several threads."""

    def __init__(self) -> None:
        self._differences_us = deque[int](maxlen=_PACKETS)

    def add(self, stamp_us: int, first_event_us: int) -> None:
        """Take a packet: its time by the clock of ROS, and that of its first event by the camera's."""
        difference_us = stamp_us - first_event_us
        if self._differences_us and abs(difference_us - self._differences_us[-1]) > _OTHER_CLOCK_US:
            self._differences_us.clear()
        self._differences_us.append(difference_us)

    def ros_time_us(self, t_us: int) -> int:
        """A time of the camera's clock by that of ROS; the same where no packet has come."""
        return t_us + min(self._differences_us, default=0)
