"""A first pose that somebody makes in the browser: the loop between the page and what is done there."""

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from torchtrack.core.windows import clipped
from torchtrack.errors import ConfigError
from torchtrack.io import EventSource
from torchtrack.run.first_pose.by_hand import HandPose, Moved, Order, TimeChosen, placed_before
from torchtrack.run.first_pose.page import PosePage, Span, check_browser
from torchtrack.run.first_pose.start import Start
from torchtrack.run.first_pose.tracked import FirstPose
from torchtrack.run.session import Session

# Times of the pose can be chosen from so much of the recording (µs): it is read anew for each.
_LONGEST_US = 10_000_000
_SLOW = {TimeChosen: "Reading the events of that time …", Order.REFINE: "Refining: this takes some seconds …"}


def pose_in_browser(session: Session, T_cam_obj: Float[Tensor, "4 4"] | None, port: int, tell: Callable[[str], None]) -> FirstPose:
    """The pose that somebody makes of a session's first object, until it is saved.

    Args:
        session: what is shown; its initial pose is not looked at.
        T_cam_obj: where the object is put at first; among the events when not given.
        port: where the page is served.
        tell: takes the address of the page.

    Raises:
        MissingExtraError: if viser is not installed.
        ConfigError: if the source is live: events of a chosen time cannot be read again.
        EventDataError: if there are no events at the start.
        OutputError: if the page cannot be served.
    """
    check_browser()
    if session.live is not None:
        raise ConfigError(f"'{session.name}' is live, and --browser needs a recording: events are read again for each time that is chosen.")
    start = Start.from_session(session)
    pose = HandPose(start, placed_before(start) if T_cam_obj is None else T_cam_obj)
    end_us = last_event_us(session.events, session.start_us, session.end_us)
    page = PosePage(pose, session.labels[0], Span(session.start_us, end_us), port)
    try:
        tell(page.url)
        return _until_saved(page, pose, session.events).result
    finally:
        page.close()


def _until_saved(page: PosePage, pose: HandPose, source: EventSource) -> HandPose:
    while not pose.saved:
        for action in page.wait():
            if text := _SLOW.get(action if isinstance(action, Order) else type(action)):
                page.tell_busy(text)
            pose = pose.after(action, source)
            page.show(pose, dragged=isinstance(action, Moved))
            if pose.saved:
                break
    return pose


def last_event_us(source: EventSource, start_us: int, end_us: int | None) -> int:
    """Time of the last event of what times can be chosen from."""
    farthest_us = start_us + _LONGEST_US
    last_us = start_us
    for batch in clipped(source.chunks(), start_us, farthest_us if end_us is None else min(end_us, farthest_us)):
        last_us = int(batch.t_us[-1])
    return last_us
