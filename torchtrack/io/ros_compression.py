"""Compressed parts of ROS bags, unpacked no further than a limit: a few bytes may stand for any number of them.

The library that reads bags unpacks whatever it is given. Its tables of decompressors are replaced by ones that stop, and messages
that are compressed one by one are unpacked here.
"""

import bz2
from collections.abc import Callable
from importlib import import_module
from typing import Any

from torchtrack.core.limits import current_limits
from torchtrack.errors import EventDataError


def bounded_decompression() -> tuple[type[Exception], ...]:
    """Have the library stop at the limit ``block_bytes``; returns what it may raise over damaged compression and databases."""
    mcap, ros1 = import_module("rosbags.rosbag2.storage_mcap"), import_module("rosbags.rosbag1.reader")
    lz4 = import_module("lz4.frame")
    mcap.DECOMPRESSORS.update(
        zstd=lambda data, size: _bounded(mcap.zstd.ZstdDecompressor, data),
        lz4=lambda data, size: _bounded(lz4.LZ4FrameDecompressor, data),
    )
    ros1.decompressors.update(
        lz4=lambda data: _bounded(lz4.LZ4FrameDecompressor, data),
        bz2=lambda data: _bounded(bz2.BZ2Decompressor, data),
    )
    return mcap.zstd.ZstdError, import_module("apsw").Error


def take_over_messages(reader: Any) -> Callable[[Any], bytes]:
    """From a reader of the library, a function from what it gives to the bytes of a message; it no longer unpacks them itself."""
    metadata = getattr(reader, "metadata", None)
    if metadata is None or getattr(metadata, "compression_mode", None) != "message":
        return bytes
    reader.metadata = metadata._replace(compression_mode=None)
    zstd = import_module("rosbags.rosbag2.reader").zstd
    return lambda data: _bounded(zstd.ZstdDecompressor, bytes(data))


def _bounded(make: Callable[[], Any], data: bytes) -> bytes:
    """All frames of some compressed bytes, up to the limit.

    Raises:
        EventDataError: if there is more, or the last frame is cut off.
    """
    most, parts, size = current_limits().block_bytes, [], 0
    while data:
        decompressor = make()
        parts.append(decompressor.decompress(data, max_length=most - size + 1))
        size += len(parts[-1])
        if size > most:
            raise EventDataError(f"a compressed part holds more than {most:,} bytes. If it is right, raise the setting limits.block_bytes.")
        if not decompressor.eof:
            raise EventDataError("a compressed part is cut off")
        data = decompressor.unused_data or b""
    return b"".join(parts)
