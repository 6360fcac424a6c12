"""What can be set about how an object model is made."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

Unit = Literal["m", "cm", "mm", "inch"]

METRES_PER_UNIT: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}


class ModelSettings(BaseModel):
    """How edges and samples are taken from a mesh."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    crease_angle_deg: float = Field(25.0, gt=0, lt=180, description="Mesh edges bent by more than this are always drawn (degrees).")
    max_texture_points: int = Field(4000, ge=0, description="At most this many points on texture edges; 0 for none.")
    texture_contrast: float = Field(
        0.5, gt=0, le=5, description="Smallest step of log luminance that counts as an edge of the texture or of the colours."
    )
    surface_point_count: int = Field(10_000, ge=100, description="Samples of the surface.")
