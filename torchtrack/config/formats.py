"""Names of the formats that events can be written in."""

from typing import Literal

OutputFormat = Literal["evt2", "evt3", "aedat4", "dsec", "npz", "csv", "sequence"]
