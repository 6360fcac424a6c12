"""Whether the first windows' events support the poses that a run starts from: told at once, and in the summary."""

from collections.abc import Callable, Sequence
from pathlib import Path

from torchtrack.run.stepping import Step
from torchtrack.tracking.validation.status import Status

# So many windows that had enough events to judge by are waited for; most of them have to be of a pose that is trusted.
_JUDGED, _SUPPORTED = 10, 5


class StartSupport:
    """Counts the first windows of one object."""

    def __init__(self) -> None:
        self._judged = self._supported = 0
        self._explained = 0.0

    def add(self, status: int, quality: float) -> None:
        """Take one window; those after the first are passed over."""
        if status == Status.TOO_FEW_EVENTS or self.is_known:
            return
        self._judged += 1
        self._supported += status == Status.TRACKING
        self._explained += quality

    @property
    def is_known(self) -> bool:
        """Whether there were windows enough."""
        return self._judged >= _JUDGED

    @property
    def supported(self) -> bool | None:
        """Whether events support the pose; None where too few windows tell."""
        return self._supported >= _SUPPORTED if self.is_known else None

    @property
    def explained_percent(self) -> float:
        """How much of the moving contour events explained, in the mean."""
        return 100 * self._explained / max(self._judged, 1)


class StartNotice:
    """A sink that tells of each object, as soon as it is known, whether events support the pose that it starts from.

    Args:
        labels: of the objects.
        tell: shows one line.
        still: picture of the first window, to look at.
        only_doubts: say nothing of poses that are supported.
    """

    def __init__(self, labels: Sequence[str], tell: Callable[[str], None], still: Path, *, only_doubts: bool = False) -> None:
        self._open = {label: (number, StartSupport()) for number, label in enumerate(labels)}
        self._tell, self._still, self._only_doubts = tell, still, only_doubts

    def add(self, step: Step) -> None:
        """Take one step."""
        if not self._open:
            return
        status, quality = step.result.status.tolist(), step.result.quality.tolist()
        for label, (number, support) in tuple(self._open.items()):
            support.add(status[number], quality[number])
            if support.is_known:
                del self._open[label]
                self._say(label, support)

    def close(self) -> None:
        """What has not been told by now stays untold: the run was too short, or had too few events, of which its statuses tell."""

    def _say(self, label: str, support: StartSupport) -> None:
        explained = f"{support.explained_percent:.0f} % of the moving contour explained in the first {_JUDGED} windows"
        if not support.supported:
            self._tell(
                f"{label}: events do NOT support the initial pose ({explained}). Look at {self._still}; `torchtrack pose` with --near finds a "
                "pose close by, with --search any."
            )
        elif not self._only_doubts:
            self._tell(f"{label}: events support the initial pose ({explained})")
