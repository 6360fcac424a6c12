"""Settings of a tracker that has come to be behind a live stream."""

from torchtrack.config.search import SearchConfig
from torchtrack.config.tracker import TrackerConfig

# A search that takes about as long as ten windows, where one takes as long as a hundred.
_HYPOTHESES, _DRAWN, _TURNS, _KEPT, _PULLED = 8, 300, 60, 30, 8


def in_haste(config: TrackerConfig, *, searches: bool) -> TrackerConfig:
    """The settings, with no time for what can wait: windows are not taken in parts, and few other poses are tried or none.

    Args:
        config: of the tracker when it keeps up.
        searches: whether objects that are lost are searched for, by fewer poses than otherwise.
    """
    window = config.window.model_copy(update={"parts": 1})
    return config.model_copy(update={"window": window, "search": _brief(config.search) if searches else _without(config.search)})


def _without(search: SearchConfig) -> SearchConfig:
    return search.model_copy(update={"hypotheses": 0})


def _brief(search: SearchConfig) -> SearchConfig:
    """A search for what is very uncertain alone."""
    fewer = {"hypotheses": _HYPOTHESES, "drawn": _DRAWN, "turns": _TURNS, "kept": _KEPT, "pulled": _PULLED}
    least: dict[str, object] = {name: min(count, getattr(search, name)) for name, count in fewer.items()}
    none = {"dropped_to": 0.0, "slipped_to": 0.0, "mirrored_to": 0.0, "strayed_to": 0.0, "new_share": 0.0, "at_start": False}
    return search.model_copy(update={**least, **none, "realigned": 0, "from_sigma_px": max(search.from_sigma_px, search.wide_sigma_px)})
