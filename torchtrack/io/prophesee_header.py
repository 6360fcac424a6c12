"""The text header of Prophesee files (RAW and DAT): lines ``% keyword value``, ended by ``% end`` or by the first byte that is no ``%``.

Both forms of RAW headers are read: ``% evt 3.0`` (with ``% geometry 1280x720`` where there is one), and
``% format EVT3;height=720;width=1280``.
"""

from dataclasses import dataclass
from pathlib import Path

_MOST_BYTES = 1 << 16
_LONGEST_LINE = 4096


@dataclass(frozen=True)
class PropheseeHeader:
    """Keywords (in lower case) and their values, and where the data start in the file."""

    fields: dict[str, str]
    offset: int

    @property
    def encoding(self) -> str | None:
        """``evt2``, ``evt21``, ``evt3`` or ``dat``; ``unknown: …`` for a RAW encoding that is not known; None if nothing says it."""
        if "format" in self.fields:
            return _encoding(self.fields["format"].partition(";")[0].lower().removeprefix("evt"))
        if "evt" in self.fields:
            return _encoding(self.fields["evt"])
        if "version" in self.fields or any(key == "data" and value.startswith("file containing") for key, value in self.fields.items()):
            return "dat"
        # Headers of the first cameras name the plug-in alone.
        plugin = self.fields.get("plugin_name", "")
        return ("evt2" if "gen3" in plugin else "evt3") if plugin else None

    @property
    def options(self) -> dict[str, str]:
        """What ``% format`` says beside the encoding, such as ``endianness``."""
        parts = self.fields.get("format", "").split(";")[1:]
        return {key.strip().lower(): value.strip() for key, _, value in (part.partition("=") for part in parts)}

    @property
    def size(self) -> tuple[int | None, int | None]:
        """Sensor width and height, where the header says them."""
        width, _, height = self.fields.get("geometry", "").partition("x")
        return (
            _whole(width or self.options.get("width") or self.fields.get("width")),
            _whole(height or self.options.get("height") or self.fields.get("height")),
        )

    @property
    def time_base_us(self) -> int:
        """What is to be added to the times of the file; a keyword of our own, see :mod:`torchtrack.io.writers.raw`."""
        text = self.fields.get("time_base_us", "0")
        return int(text) if text.removeprefix("-").isdigit() and len(text) < 19 else 0

    @property
    def default_size(self) -> tuple[int, int] | None:
        """Sensor size as the generation of the camera tells it."""
        text = " ".join(self.fields.get(key, "") for key in ("plugin_name", "generation", "sensor_name", "sensor_info")).lower()
        for names, size in ((("genx320",), (320, 320)), (("gen3",), (640, 480)), (("gen4", "imx636"), (1280, 720))):
            if any(name in text for name in names):
                return size
        return None


def parse_header(head: bytes) -> PropheseeHeader | None:
    """The header at the beginning of a file, or None if there is none."""
    fields: dict[str, str] = {}
    offset = 0
    while head[offset : offset + 1] == b"%":
        end = head.find(b"\n", offset, offset + _LONGEST_LINE)
        line = head[offset:end]
        # Data may begin with the same byte; they are not text.
        if end < 0 or not all(32 <= byte < 127 or byte in b"\t\r" for byte in line):
            break
        key, _, value = line[1:].decode("ascii").strip().partition(" ")
        offset = end + 1
        if key == "end":
            break
        fields[key.lower()] = value.strip()
    return PropheseeHeader(fields, offset) if fields else None


def read_header(path: Path) -> PropheseeHeader | None:
    """The header of a file, or None if it has none."""
    with path.open("rb") as stream:
        return parse_header(stream.read(_MOST_BYTES))


def _encoding(name: str) -> str:
    known = {"2": "evt2", "2.0": "evt2", "21": "evt21", "2.1": "evt21", "3": "evt3", "3.0": "evt3"}
    return known.get(name.strip(), f"unknown: {name.strip()}")


def _whole(text: str | None) -> int | None:
    return int(text) if text and text.isdigit() and 0 < int(text) <= 1 << 16 else None
