"""The base of all stages."""

from dataclasses import dataclass, replace

from torchtrack.io.event_stream import DerivedStream, EventStream, LaterStream


@dataclass(frozen=True)
class Stage(DerivedStream):
    """A stream made of another one that also seeks in that one."""

    def seek(self, t_us: int) -> "Stage":
        """The same stages over the stream from the first event with ``t >= t_us`` on."""
        inner = self.inner.seek(t_us) if isinstance(self.inner, EventStream) else LaterStream(self.inner, t_us)
        return replace(self, inner=inner)
