"""Settings of when a pose is trusted."""

from pydantic import Field

from torchtrack.config.settings import Settings


class ValidationConfig(Settings):
    """When a pose is trusted."""

    min_observations: int = Field(30, ge=6, description="Fewer matched observations: the pose is not updated.")
    min_visible_ratio: float = Field(0.2, ge=0, le=1, description="A smaller share of the contour inside the image: out of view.")
    uncertain_below: float = Field(0.4, ge=0, le=1, description="Share of the moving contour explained by events below which a pose is uncertain.")
    lost_below: float = Field(0.1, ge=0, le=1, description="Share of the moving contour explained by events below which a pose is lost.")
    max_rotation_rad: float = Field(0.5, gt=0, description="A larger rotation against the prediction within one window has diverged (rad).")
    max_translation: float = Field(0.5, gt=0, description="A larger move against the prediction within one window has diverged (diameters).")
