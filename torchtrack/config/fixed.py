"""Settings of the tracker that are constants or components now: they are refused with that."""

from torchtrack.config.components import Component

# Constants, with their values, by sections.
FIXED: dict[str, dict[str, str]] = {
    "window": {"max_age_us": "20000"},
    "surface": {
        "margin_px": "12, and at 16 with association.search along_flow",
        "max_region_px": "256",
        "filter_size_px": "5",
        "filter_eps": "0.01",
        "filter_subsample": "1",
    },
    "corners": {"relative_threshold": "0.001"},
    "flow": {"always": "false", "span_s": "0.02", "tuning": "4.685", "min_events": "8"},
    "contours": {
        "occluding": "true",
        "segments": "true",
        "max_texture_points": "4000",
        "spacing_px": "0.5",
        "exact_faces": "512",
        "depth_cell_px": "4",
        "depth_margin": "0.06",
        "splat_radius_px": "3",
        "refresh_rounds": "the first, and at all with contours.source splat",
    },
    "association": {"index_cell_px": "2"},
}

# Components, which ``disabled`` switches off, by sections.
SWITCHES: dict[str, dict[str, Component]] = {
    "corners": {"snap": Component.CORNER_SNAP, "fresh_only": Component.FRESH_CORNERS},
}


def fixed(location: tuple[int | str, ...]) -> str | None:
    """What a setting at a place that is not known is now; None where it is neither a constant nor a component.

    Args:
        location: its keys, from the outermost.
    """
    *before, name = location
    section = str(before[-1]) if before else ""
    if value := FIXED.get(section, {}).get(str(name)):
        return f"fixed at {value} now"
    if component := SWITCHES.get(section, {}).get(str(name)):
        return f"a component now: '{'.'.join(map(str, (*before[:-1], 'disabled')))}: [{component}]' switches it off"
    return None
