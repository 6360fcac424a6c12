"""Settings of how a pose is judged, and of when and where others are tried."""

from pydantic import Field

from torchtrack.config.settings import Settings


class RelocalizationConfig(Settings):
    """Many poses tried at once, where one prediction is too uncertain or a pose explains less than it did."""

    objects: int = Field(
        2, ge=1, le=1000, description="Objects of a stream looked for in a window, at most: those least often so far, and of these the longest lost."
    )
    hypotheses: int = Field(24, ge=0, le=1000, description="Poses aligned at once; 0 switches the search off.")
    rotations: int = Field(
        1000, ge=1, le=10_000, description="Rotations and depths sampled where a prediction is very uncertain, tried in all places of the image."
    )
    trigger_sigma_px: float = Field(4.0, gt=0, description="Standard deviation of the prediction in the image from which other poses are tried (px).")
    wide_sigma_px: float = Field(10.0, gt=0, description="Standard deviation of the prediction from which it is very uncertain (px).")
    interval_us: int = Field(
        10_000,
        ge=0,
        description="A very uncertain object is searched for once in this time (µs), half as often from 0.1, 0.2, 0.4 and 0.8 s on; 0: in all.",
    )
    answer_after_us: int = Field(
        0,
        ge=0,
        le=1_000_000,
        description="Searches go on beside the windows, on another core, and are answered after so long (µs); 0: windows wait.",
    )
    not_validated_below: float = Field(
        0.75,
        ge=0,
        le=1,
        description="Share of what an object explains when seen well below which, for 0.1 s, it is looked for all around there; 0 for never.",
    )
    new_below: float = Field(
        0.9, ge=0, le=1, description="For its first windows, an object that explains less is searched for where this much is explained; 0 for never."
    )
    slow_drift_below: float = Field(
        0.85, ge=0, le=1, description="Share of what an object explains when seen well below which, for 50 ms, it is looked for as well; 0 for never."
    )
    accept_margin: float = Field(0.1, ge=0, le=1, description="By how much the score of a pose near the prediction must be better to be accepted.")
    accept_ratio: float = Field(0.9, ge=0, le=1, description="Share of what an object explains when seen well that is asked of a pose elsewhere.")
    everywhere_after_us: int = Field(
        1_000_000,
        ge=0,
        description="What was lost for so long is searched for in the whole image and all rotations, a part of that in each window (µs); 0: never.",
    )
