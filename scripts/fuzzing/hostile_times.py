"""Clocks that jump by any amount, and times at the ends of what 64 bits hold."""

import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from seeds import HEIGHT, WIDTH, aedat4

Make = Callable[[Path], None]
_MOST = 2**63 - 1
_TIMES = {
    "ends": [-_MOST - 1, -_MOST, 0, _MOST - 1, _MOST],
    "jump": [1000, 2000, 10**15, 10**15 + 1, 2 * 10**15],
    "jumps": [0, 10**15, 0, 10**15, 5],
    "back": [10**15, 10**15 + 5, 1000, 1001, 1002],
    "latest": [_MOST - 4, _MOST - 3, _MOST - 2, _MOST - 1, _MOST],
    "earliest": [-_MOST - 1, -_MOST, -_MOST + 1, -_MOST + 2, -_MOST + 3],
    "spikes": [1000, _MOST, 2000, -_MOST - 1, 3000],
}


def time_inputs() -> Iterator[tuple[str, str, str, Make]]:
    """Name, kind, file, and what makes it."""
    for name, times in _TIMES.items():
        t_us = np.array(times * 20, np.int64)
        if name not in ("jumps", "spikes"):
            t_us = np.sort(t_us)
        yield f"times_{name}_npz", "events", "x.npz", partial(_npz, t_us=t_us)
        yield f"times_{name}_csv", "events", "x.csv", partial(_csv, t_us=t_us)
        yield f"times_{name}_text", "events", "x.txt", partial(_text, t_us=t_us)
        yield f"times_{name}_hdf5", "events", "x.h5", partial(_hdf5, t_us=t_us)
        yield f"times_{name}_offset", "events", "x.h5", partial(_hdf5, t_us=t_us, t_offset=_MOST)
        yield f"times_{name}_aedat4", "events", "x.aedat4", partial(_aedat4, t_us=t_us)
    for base in (_MOST, -_MOST, 10**17):
        head = f"% evt 3.0\n% geometry 64x48\n% time_base_us {base}\n% end\n".encode()
        words = np.array([0x8000, 0x6000, 0x0001, 0x2002, 0x8FFF, 0x6001, 0x2003, 0x8000, 0x2004], "<u2").tobytes()
        yield f"times_base_{base}", "events", "x.raw", partial(Path.write_bytes, data=head + words * 50)
    wraps = np.tile(np.array([0x8000, 0x0001, 0x2002, 0x8800, 0x2003], "<u2"), 100_000).tobytes()
    yield "times_wraps", "events", "x.raw", partial(Path.write_bytes, data=b"% evt 3.0\n% geometry 64x48\n% end\n" + wraps)
    words = np.tile(np.array([0x80000000, 0x10000801, 0x8FFFFFFF, 0x10000802], "<u4"), 50_000).tobytes()
    yield "times_wraps_evt2", "events", "x.raw", partial(Path.write_bytes, data=b"% evt 2.0\n% geometry 64x48\n% end\n" + words)


def _columns(t_us: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    index = np.arange(len(t_us))
    return index % WIDTH, index % HEIGHT, index % 2


def _npz(path: Path, t_us: np.ndarray) -> None:
    x, y, p = _columns(t_us)
    np.savez(path, t=t_us, x=x, y=y, p=p, width=WIDTH, height=HEIGHT)


def _csv(path: Path, t_us: np.ndarray) -> None:
    rows = zip(t_us.tolist(), *(column.tolist() for column in _columns(t_us)), strict=True)
    path.write_text(f"# width={WIDTH} height={HEIGHT}\n" + "".join(f"{t},{x},{y},{p}\n" for t, x, y, p in rows))


def _text(path: Path, t_us: np.ndarray) -> None:
    rows = zip(t_us.tolist(), *(column.tolist() for column in _columns(t_us)), strict=True)
    path.write_text("0.000001 1 1 1\n" + "".join(f"{t // 10**6}.{t % 10**6:06d} {x} {y} {p}\n" for t, x, y, p in rows))


def _hdf5(path: Path, t_us: np.ndarray, t_offset: int = 0) -> None:
    with h5py.File(path, "w") as file:
        file.attrs["width"], file.attrs["height"] = WIDTH, HEIGHT
        for name, values in zip("txyp", (t_us, *_columns(t_us)), strict=True):
            file[f"events/{name}"] = values
        file["t_offset"] = np.int64(t_offset)


def _aedat4(path: Path, t_us: np.ndarray) -> None:
    x, y, p = _columns(t_us)
    records = np.zeros(len(t_us), np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("on", "u1"), ("pad", "V3")]))
    records["t"], records["x"], records["y"], records["on"] = t_us, x, y, p
    content = (
        struct.pack("<I", 12) + struct.pack("<HHH", 6, 8, 4) + b"\0\0" + struct.pack("<iI", 8, 4) + struct.pack("<I", len(t_us)) + records.tobytes()
    )
    packet = struct.pack("<I", len(content)) + content
    path.write_bytes(aedat4(0, 0) + struct.pack("<ii", 0, len(packet)) + packet)
