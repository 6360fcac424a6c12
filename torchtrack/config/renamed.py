"""Settings of the tracker that have another name now, or are gone: they are refused with the new name, or with the reason."""

from collections.abc import Mapping
from typing import Any

from torchtrack.config.fixed import fixed

SECTIONS = {"search": "relocalization", "quality": "validation", "matching": "association", "learning": "adaptation"}
KEYS = {
    "search": {
        "drawn": "samples",
        "turns": "rotations",
        "kept": "kept_rotations",
        "dropped_to": "low_score_below",
        "slipped_to": "score_drop_below",
        "anew_us": "not_validated_us",
        "anew_below": "not_validated_below",
        "slip_sigma_px": "score_drop_sigma_px",
        "new_share": "new_below",
        "by_gathering": "by_inlier_ratio",
        "doubted_below": "drift_below",
        "doubt_us": "drift_us",
        "strayed_to": "slow_drift_below",
        "stands_from": "held_from",
        "by_events": "by_matches",
        "unseen_us": "last_seen_us",
        "probation": "tentative",
        "adrift_share": "drift_min_ratio",
        "slip_margin": "elsewhere_margin",
        "slip_share": "accept_ratio",
    },
    "quality": {
        "certain_at": "validated_from",
        "caught_above": "refound_above",
        "min_visible_share": "min_visible_ratio",
    },
    "matching": {
        "limb_dark_shift_px": "silhouette_dark_shift_px",
        "learned_trust": "weighting_network",
        "polarity_memory_s": "polarity_prior_s",
    },
    "learning": {
        "below_share": "below_ratio",
        "up_to_share": "up_to_ratio",
    },
    "association": {"along_flow": "search"},
    "adaptation": {"points": "learned_points"},
    "validation": {"max_step_rotation_rad": "max_rotation_rad", "max_step_translation": "max_translation"},
    "relocalization": {"from_sigma_px": "trigger_sigma_px", "margin": "accept_margin", "elsewhere_min_ratio": "accept_ratio"},
}

# Settings that were removed, by their sections: what is done in their place, or why nothing is.
REMOVED: dict[str, dict[str, str]] = {
    "surface": {
        "filters": "kornia's filters run, and on a CPU with the extra 'fast' their faster equal",
    },
    "contours": {
        "mid_window": "contours are those that show at the window's end",
    },
    "association": {
        "burst_px": "events count at their own times, however late in a burst",
        "burst_us": "events count at their own times, however late in a burst",
        "pixel_latency": "events count at their own times, however late in a burst",
        "edge_ambiguity_px": "what is seen of parallel edges counts in full, however close they are",
    },
    "solver": {
        "acceleration_in_window": "the velocity is the same all along a window",
        "silhouette_offset_px": "smooth silhouettes lie where their model has them",
        "swelling_px": "smooth silhouettes lie where their model has them",
    },
    "motion": {
        "acceleration_px": "no acceleration is estimated",
        "acceleration_s": "no acceleration is estimated",
        "spin_fades": "a spin that no event shows goes on",
    },
    "relocalization": {
        "axis_rotation": "no rotations about an axis are compared",
        "mirrored_below": "no poses mirrored in depth are tried",
        "realignments": "every pose is aligned once",
        "at_start": "what starts is searched for as any other object",
        "by_matches": "poses are compared by what they explain, however many events that are",
        "last_seen_us": "what was not seen well for long is looked for all around where it was then",
        "held_from": "what drifts is looked for farther away, however much it explains where it is",
        "score_drop_below": "a score that drops is acted on where it stays low",
        "score_drop_sigma_px": "a score that drops is acted on where it stays low",
        "tentative": "what a search gives is UNCERTAIN until windows enough confirm it",
    },
    "validation": {
        "holds_on": "a pose that goes on from the one before is asked for as much as any other",
    },
}


def _removed(location: tuple[int | str, ...]) -> str | None:
    """That a setting at a place that is not known was removed, and why; None where there never was one."""
    *before, name = location
    why = REMOVED.get(str(before[-1]), {}).get(str(name)) if before else None
    return why and f"removed, leave it out: {why}"


def renamed(location: tuple[int | str, ...], value: Any) -> str | None:
    """What a setting at a place that is not known is called now; None where it never had another name.

    Args:
        location: its keys, from the outermost.
        value: that was given: of a whole section, the keys in it may have other names too.
    """
    *before, name = location
    if name in SECTIONS:
        place, inner = (*before, SECTIONS[str(name)]), KEYS[str(name)]
        keys = list(map(str, value)) if isinstance(value, Mapping) else []
        now = {key: no_setting((*place, inner.get(key, key))) or (f"now '{inner[key]}'" if key in inner else None) for key in keys}
        return ", ".join([f"'{'.'.join(map(str, place))}'", *(f"'{key}' is {what}" for key, what in now.items() if what)])
    section = str(before[-1]) if before else ""
    for old, new in (*SECTIONS.items(), *((section, section) for section in KEYS if section not in SECTIONS)):
        if section == new and name in KEYS[old]:
            place = (*before, KEYS[old][str(name)])
            what = no_setting(place)
            return f"'{'.'.join(map(str, place))}'" + (f", which is {what}" if what else "")
    return None


def no_setting(location: tuple[int | str, ...]) -> str | None:
    """What became of a setting that is none now; None where there never was one, or it has another name.

    Args:
        location: its keys, from the outermost.
    """
    return fixed(location) or _removed(location)
