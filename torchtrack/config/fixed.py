"""Settings of the tracker that are constants or components now: they are refused with that."""

from torchtrack.config.components import Component

# Constants, with their values, by sections.
FIXED: dict[str, dict[str, str]] = {
    "window": {"max_age_us": "20000", "max_unknown_px": "2"},
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
    "association": {
        "index_cell_px": "2",
        "max_gate_px": "16",
        "gate_sigmas": "3",
        "fine_below_px": "120",
        "flow_tolerance_px": "2",
        "smeared_share": "0.35",
        "gathered_share": "0.6",
        "least_trust": "0.02",
        "polarity_gain": "1.5",
        "least_agreement": "0.05",
    },
    "solver": {"gradient_iterations": "1"},
    "motion": {"coast_s": "0.2"},
    "adaptation": {
        "events": "1000",
        "drafts": "4096",
        "trusted_from": "3",
        "below_ratio": "0.6",
        "up_to_ratio": "0.8",
        "max_sigma_px": "2",
        "first_windows": "20",
        "every": "10",
    },
    "validation": {
        "refound_above": "0.35",
        "validated_from": "0.75",
        "min_on_contour": "3, and at 1 where corners alone are observed",
        "min_speed_px_s": "30",
    },
    "relocalization": {
        "samples": "2000, and at five for each of relocalization.rotations where these are less",
        "kept_rotations": "0.512 of relocalization.rotations",
        "pulled": "an eighth of the rotations that are kept",
        "least_sigma_px": "3",
        "drift_below": "0.6",
        "drift_px_s": "200",
        "drift_diameters_s": "1.5",
        "drift_min_ratio": "0.65",
        "start_margin": "0.02",
        "elsewhere_margin": "0.15",
    },
}

# Components, which ``disabled`` switches off, by sections.
SWITCHES: dict[str, dict[str, Component]] = {
    "window": {"parts": Component.WINDOW_PARTS},
    "corners": {"snap": Component.CORNER_SNAP, "fresh_only": Component.FRESH_CORNERS},
    "association": {
        "fine_unless_plain": Component.SUBCELL_LOOKUP,
        "polarity_prior_s": Component.POLARITY_PRIOR,
        "texture_polarity": Component.TEXTURE_POLARITY,
        "dark_shift_px": Component.DARK_SHIFT,
        "silhouette_dark_shift_px": Component.SILHOUETTE_DARK_SHIFT,
    },
    "solver": {"velocity_in_window": Component.VELOCITY_IN_WINDOW, "common_px": Component.COMMON_ERROR},
    "motion": {"speed_from_events": Component.SPEED_FROM_EVENTS, "turn_s": Component.TURNS_FADE},
    "validation": {"partly_hidden": Component.PARTLY_HIDDEN, "all_directions": Component.ALL_DIRECTIONS},
    "relocalization": {
        "low_score_below": Component.LOW_SCORE,
        "not_validated_us": Component.AROUND_LAST_SEEN,
        "line_ends": Component.LINE_ENDS,
        "by_inlier_ratio": Component.INLIER_RATIO,
        "drift_us": Component.DRIFT,
    },
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
