"""Settings of how a pose is judged, and of when and where others are tried."""

from pydantic import Field

from torchtrack.config.settings import Settings


class SearchConfig(Settings):
    """Many poses tried at once, where one prediction is too uncertain or a pose explains less than it did."""

    hypotheses: int = Field(24, ge=0, le=1000, description="Poses aligned at once; 0 switches the search off.")
    drawn: int = Field(2000, ge=1, le=100_000, description="Poses drawn from the prediction, of which the most promising are aligned.")
    turns: int = Field(
        1000, ge=1, le=10_000, description="Turns and depths drawn where a prediction is very uncertain, tried in all places of the image."
    )
    kept: int = Field(512, ge=1, le=10_000, description="The best of these, which are pulled onto the events around them.")
    pulled: int = Field(64, ge=1, le=1000, description="Those of them that are pulled once more, from nearer.")
    realigned: int = Field(
        2, ge=0, le=20, description="How many times the best poses of a very uncertain object are aligned again, each from where it came to."
    )
    wide_sigma_px: float = Field(10.0, gt=0, description="Standard deviation of the prediction in the image from which that is so (px).")
    interval_us: int = Field(10_000, ge=0, description="A very uncertain object is searched for once in this time (µs); 0 for in every window.")
    from_sigma_px: float = Field(4.0, gt=0, description="Standard deviation of the prediction in the image from which others are tried (px).")
    dropped_to: float = Field(0.8, ge=0, le=1, description="Share of the usual quality below which others are tried, two windows in a row.")
    slipped_to: float = Field(0.7, ge=0, le=1, description="Share of the usual quality below which a pose may have slipped; 0 for never.")
    mirrored_to: float = Field(
        0.8, ge=0, le=1, description="Share of what an object explains when seen well below which it may be mirrored in depth; 0 for never."
    )
    turned: bool = Field(
        True, description="What can be turned about an axis nearly unseen is not taken to be seen well again until events tell how it is turned."
    )
    unseen_us: int = Field(
        200_000, ge=0, description="What may be far away and was not seen well for so long is also looked for as it was then (µs); 0 for never."
    )
    anew_us: int = Field(
        100_000,
        ge=0,
        description="What was not seen well for so long, and is lost or far off in depth, is looked for all around where it was then (µs); 0: never.",
    )
    anew_below: float = Field(
        0.75, ge=0, le=1, description="Share of what an object explains when seen well below which, as long, it is looked for there; 0 for never."
    )
    by_events: bool = Field(
        True, description="Poses of very uncertain objects are also compared by how many events they explain: far away, a few explain all."
    )
    line_ends: bool = Field(
        True, description="Poses of very uncertain objects count less where events go on, in line, beyond the ends of their straight contours."
    )
    least_sigma_px: float = Field(3.0, gt=0, description="Others are drawn with at least this standard deviation in the image (px).")
    slip_sigma_px: float = Field(6.0, gt=0, description="The same of what may have slipped, however sure it is of itself (px).")
    at_start: bool = Field(True, description="Others are also tried while an object's motion is not known: dense print fits many.")
    new_share: float = Field(
        0.9, ge=0, le=1, description="For its first windows, an object that explains less is searched for where this much is explained; 0 for never."
    )
    probation: bool = Field(True, description="What was found of a very uncertain object is taken back unless it explains as much as usual soon.")
    by_gathering: bool = Field(True, description="Poses are also compared by how far the events around contours gather on them: slips smear them.")
    doubted_below: float = Field(0.6, ge=0, le=1, description="Share of what an object explains when it is seen well below which it is in doubt.")
    doubt_us: int = Field(50_000, ge=0, description="What is in doubt for so long is looked for farther away, once in this time (µs); 0 for never.")
    strayed_to: float = Field(
        0.85, ge=0, le=1, description="Share of what an object explains when seen well below which, as long, it is looked for as well; 0 for never."
    )
    stands_from: float = Field(
        0.25,
        ge=0,
        le=1,
        description="Share of what an object explains when seen well from which, in doubt, it is looked for near its place alone; 0 for never.",
    )
    drift_px_s: float = Field(200.0, gt=0, description="How fast it may have drifted off since the doubt began (px/s).")
    drift_diameters_s: float = Field(1.5, gt=0, description="The same for objects that are small in the image (diameters/s); the slower counts.")
    adrift_share: float = Field(0.65, ge=0, le=1, description="Share of what an object explains when seen well that is asked of a find farther away.")
    start_margin: float = Field(0.02, ge=0, le=1, description="By how much the quality of another pose must be better then.")
    margin: float = Field(0.1, ge=0, le=1, description="By how much the quality of another pose must be better.")
    slip_margin: float = Field(0.15, ge=0, le=1, description="The same where a pose may have slipped, be mirrored, or be as last seen well.")
    slip_share: float = Field(0.9, ge=0, le=1, description="Share of what an object explains when seen well that is asked of a pose then.")


class QualityConfig(Settings):
    """When a pose is trusted."""

    min_observations: int = Field(30, ge=6, description="Fewer matched observations: the pose is not updated.")
    min_visible_share: float = Field(0.2, ge=0, le=1, description="A smaller share of the contour inside the image: out of view.")
    uncertain_below: float = Field(0.4, ge=0, le=1, description="Share of the moving contour explained by events below which a pose is uncertain.")
    lost_below: float = Field(0.1, ge=0, le=1, description="Share of the moving contour explained by events below which a pose is lost.")
    caught_above: float = Field(
        0.35, ge=0, le=1, description="Share of the moving contour explained by events from which an uncertain object is found again."
    )
    certain_at: float = Field(0.75, ge=0, le=1, description="Share of the quality when seen well, from which the find of an uncertain object counts.")
    partly_hidden: bool = Field(
        True,
        description="A pose that explains little counts where events gather on its contours as when the object is seen well: it is partly hidden.",
    )
    holds_on: bool = Field(
        True,
        description="A pose by many events that goes on from the one before is not asked for `caught_above`: it was not lost, but is hidden more.",
    )
    all_directions: bool = Field(
        True, description="What has not been seen well for a while has to be held by more than parallel lines: those of what hides it are."
    )
    min_on_contour: int = Field(3, ge=1, description="Observations on the contours of a patch of the image from which these are explained.")
    min_speed_px_s: float = Field(30.0, ge=0, description="Contours moving slower than this across themselves need not fire (px/s).")
    max_step_rotation_rad: float = Field(0.5, gt=0, description="A larger rotation against the prediction within one window has diverged (rad).")
    max_step_translation: float = Field(0.5, gt=0, description="A larger move against the prediction within one window has diverged (diameters).")
