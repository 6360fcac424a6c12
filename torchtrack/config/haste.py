"""Settings of a tracker that has come to be behind a live stream."""

from torchtrack.config.components import Component
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import TrackerConfig

# A search that takes about as long as ten windows, where one takes as long as a hundred.
_HYPOTHESES, _ROTATIONS = 8, 60
# What is not searched for at all, and what takes a window several times over.
_LEFT_OUT = frozenset({Component.LOW_SCORE, Component.UNCONFIRMED, Component.WINDOW_PARTS})


def in_haste(config: TrackerConfig, *, searches: bool) -> TrackerConfig:
    """The settings, with no time for what can wait: windows are not taken in parts, and few other poses are tried or none.

    Args:
        config: of the tracker when it keeps up.
        searches: whether objects that are lost are searched for, by fewer poses than otherwise.
    """
    hasty = config.model_copy(update={"relocalization": _brief(config.relocalization)}) if searches else config.without_searches()
    return hasty.model_copy(update={"disabled": config.disabled | _LEFT_OUT})


def _brief(search: RelocalizationConfig) -> RelocalizationConfig:
    """A search for what is very uncertain alone."""
    fewer = {"hypotheses": _HYPOTHESES, "rotations": _ROTATIONS}
    least: dict[str, object] = {name: min(count, getattr(search, name)) for name, count in fewer.items()}
    none = {"slow_drift_below": 0.0, "new_below": 0.0}
    return search.model_copy(update={**least, **none, "trigger_sigma_px": max(search.trigger_sigma_px, search.wide_sigma_px)})
