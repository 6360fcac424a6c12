"""Settings of how a pose is judged, and of when and where others are tried."""

from pydantic import Field

from torchtrack.config.settings import Settings


class RelocalizationConfig(Settings):
    """Many poses tried at once, where one prediction is too uncertain or a pose explains less than it did."""

    hypotheses: int = Field(24, ge=0, le=1000, description="Poses aligned at once; 0 switches the search off.")
    samples: int = Field(2000, ge=1, le=100_000, description="Poses sampled from the prediction, of which the best by score are aligned.")
    rotations: int = Field(
        1000, ge=1, le=10_000, description="Rotations and depths sampled where a prediction is very uncertain, tried in all places of the image."
    )
    kept_rotations: int = Field(512, ge=1, le=10_000, description="The best of these, which are pulled onto the events around them.")
    pulled: int = Field(64, ge=1, le=1000, description="Those of them that are pulled once more, from nearer.")
    realignments: int = Field(
        2, ge=0, le=20, description="How many times the best poses of a very uncertain object are aligned again, each from where it came to."
    )
    wide_sigma_px: float = Field(10.0, gt=0, description="Standard deviation of the prediction in the image from which that is so (px).")
    interval_us: int = Field(10_000, ge=0, description="A very uncertain object is searched for once in this time (µs); 0 for in every window.")
    from_sigma_px: float = Field(4.0, gt=0, description="Standard deviation of the prediction in the image from which others are tried (px).")
    low_score_below: float = Field(0.8, ge=0, le=1, description="Share of the usual quality below which others are tried, two windows in a row.")
    score_drop_below: float = Field(0.7, ge=0, le=1, description="Share of the usual quality below which other poses are tried at once; 0 for never.")
    mirrored_below: float = Field(
        0.8, ge=0, le=1, description="Share of what an object explains when seen well below which it may be mirrored in depth; 0 for never."
    )
    axis_rotation: bool = Field(
        True, description="What can be turned about an axis nearly unseen is not taken to be seen well again until events tell how it is turned."
    )
    last_seen_us: int = Field(
        200_000, ge=0, description="What may be far away and was not seen well for so long is also looked for as it was then (µs); 0 for never."
    )
    not_validated_us: int = Field(
        100_000,
        ge=0,
        description="What was not seen well for so long, and is lost or far off in depth, is looked for all around where it was then (µs); 0: never.",
    )
    not_validated_below: float = Field(
        0.75, ge=0, le=1, description="Share of what an object explains when seen well below which, as long, it is looked for there; 0 for never."
    )
    by_matches: bool = Field(
        True, description="Poses of very uncertain objects are also compared by how many events they explain: far away, a few explain all."
    )
    line_ends: bool = Field(
        True, description="Poses of very uncertain objects count less where events go on, in line, beyond the ends of their straight contours."
    )
    least_sigma_px: float = Field(3.0, gt=0, description="Others are drawn with at least this standard deviation in the image (px).")
    score_drop_sigma_px: float = Field(6.0, gt=0, description="The same after such a drop of the score, however sure it is of itself (px).")
    at_start: bool = Field(True, description="Others are also tried while an object's motion is not known: dense texture fits many.")
    new_below: float = Field(
        0.9, ge=0, le=1, description="For its first windows, an object that explains less is searched for where this much is explained; 0 for never."
    )
    tentative: bool = Field(True, description="What was found of a very uncertain object is taken back unless it explains as much as usual soon.")
    by_inlier_ratio: bool = Field(
        True, description="Poses are also compared by how far the events around contours gather on them: a wrong pose smears them."
    )
    drift_below: float = Field(0.6, ge=0, le=1, description="Share of what an object explains when it is seen well below which it drifts.")
    drift_us: int = Field(50_000, ge=0, description="What drifts for so long is looked for farther away, once in this time (µs); 0 for never.")
    slow_drift_below: float = Field(
        0.85, ge=0, le=1, description="Share of what an object explains when seen well below which, as long, it is looked for as well; 0 for never."
    )
    held_from: float = Field(
        0.25,
        ge=0,
        le=1,
        description="Share of what an object explains when seen well from which, it is looked for near its place alone while it drifts; 0: never.",
    )
    drift_px_s: float = Field(200.0, gt=0, description="How fast it may have drifted off since then (px/s).")
    drift_diameters_s: float = Field(1.5, gt=0, description="The same for objects that are small in the image (diameters/s); the slower counts.")
    drift_min_ratio: float = Field(
        0.65, ge=0, le=1, description="Share of what an object explains when seen well that is asked of a find farther away."
    )
    start_margin: float = Field(0.02, ge=0, le=1, description="By how much the quality of another pose must be better then.")
    margin: float = Field(0.1, ge=0, le=1, description="By how much the quality of another pose must be better.")
    elsewhere_margin: float = Field(
        0.15, ge=0, le=1, description="The same where the score dropped, or a pose may be mirrored, or be as last seen well."
    )
    elsewhere_min_ratio: float = Field(0.9, ge=0, le=1, description="Share of what an object explains when seen well that is asked of a pose then.")
