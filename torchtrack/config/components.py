"""Parts of the tracker that can be left out, each by its name, to see what it is worth."""

from enum import StrEnum


class Component(StrEnum):
    """What ``tracker.disabled`` may name; docs/method.md says what each does."""

    # corners
    CORNER_SNAP = "corner_snap"
    FRESH_CORNERS = "fresh_corners"
    # association
    OTHERS_EVENTS = "others_events"
    POLARITY_PRIOR = "polarity_prior"
    TEXTURE_POLARITY = "texture_polarity"
    DARK_SHIFT = "dark_shift"
    SILHOUETTE_DARK_SHIFT = "silhouette_dark_shift"
    COMMON_ERROR = "common_error"
    WIDE_GATES = "wide_gates"
    SUBCELL_LOOKUP = "subcell_lookup"
    # motion
    SPEED_FROM_EVENTS = "speed_from_events"
    WINDOW_PARTS = "window_parts"
    TURNS_FADE = "turns_fade"
    # estimation and validation
    VELOCITY_IN_WINDOW = "velocity_in_window"
    PARTLY_HIDDEN = "partly_hidden"
    # why other poses are tried
    LOW_SCORE = "low_score"
    DRIFT = "drift"
    AROUND_LAST_SEEN = "around_last_seen"
    UNCONFIRMED = "unconfirmed"
    # how they are compared
    INLIER_RATIO = "inlier_ratio"
    LINE_ENDS = "line_ends"
    ALL_DIRECTIONS = "all_directions"
