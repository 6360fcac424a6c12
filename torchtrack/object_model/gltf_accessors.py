"""Numbers of a glTF file as its accessors give them: strided, sparse, or as normalised integers."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

Tree = dict[str, Any]

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


@dataclass
class GltfContent:
    """What a glTF file holds: its JSON ``tree``, which may be changed, and the bytes of its ``buffers``."""

    tree: Tree
    buffers: list[bytes] = field(default_factory=list)

    def accessor(self, index: Any) -> Tree:
        """The accessor of that index (a negative one is not a Python index).

        Raises:
            IndexError: if there is none.
        """
        accessor: Tree = at(self.tree["accessors"], index)
        return accessor

    def values(self, index: int) -> np.ndarray:
        """The values ``[n, k]`` of an accessor; normalised integers as float64 in 0..1 or -1..1."""
        accessor = self.accessor(index)
        width, dtype = _WIDTHS[accessor["type"]], np.dtype(_DTYPES[accessor["componentType"]])
        values = self._dense(accessor, accessor["count"], width, dtype)
        if "sparse" in accessor:
            values = self._with_sparse(values, accessor["sparse"], width, dtype)
        if accessor.get("normalized", False):
            return np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def add(self, values: np.ndarray, kind: str, component: int) -> int:
        """Store values ``[n, k]`` as a new accessor; its index."""
        data = np.ascontiguousarray(values, dtype=_DTYPES[component]).tobytes()
        self.tree["buffers"].append({"byteLength": len(data)})
        self.buffers.append(data)
        self.tree["bufferViews"].append({"buffer": len(self.buffers) - 1, "byteLength": len(data)})
        self.tree["accessors"].append(
            {"bufferView": len(self.tree["bufferViews"]) - 1, "componentType": component, "count": len(values), "type": kind}
        )
        return len(self.tree["accessors"]) - 1

    def _dense(self, place: Tree, count: int, width: int, dtype: np.dtype) -> np.ndarray:
        """``count`` rows from a buffer view; zeros, if ``place`` has none."""
        if "bufferView" not in place:
            return np.zeros((count, width), dtype=dtype)
        view = at(self.tree["bufferViews"], place["bufferView"])
        start = view.get("byteOffset", 0) + place.get("byteOffset", 0)
        row = dtype.itemsize * width
        stride = view.get("byteStride", row)
        needed = stride * (count - 1) + row if count else 0
        data = np.frombuffer(at(self.buffers, view["buffer"]), dtype=np.uint8)[start : start + needed]
        if len(data) < needed or stride < row or start < 0:
            raise ValueError(f"an accessor reads {needed} bytes from byte {start} of a buffer that has {len(at(self.buffers, view['buffer']))}")
        rows = np.lib.stride_tricks.as_strided(data, (count, row), (stride, 1))
        return np.ascontiguousarray(rows).view(dtype).reshape(count, width)

    def _with_sparse(self, values: np.ndarray, sparse: Tree, width: int, dtype: np.dtype) -> np.ndarray:
        """The values with those replaced that ``sparse`` lists."""
        replaced = self._dense(sparse["indices"], sparse["count"], 1, np.dtype(_DTYPES[sparse["indices"]["componentType"]])).reshape(-1)
        values = values.copy()
        values[replaced] = self._dense(sparse["values"], sparse["count"], width, dtype)
        return values


def at(items: Any, index: Any) -> Any:
    """The item of an index of the file, which never counts from the end.

    Raises:
        IndexError: if there is none.
    """
    if not 0 <= index < len(items):
        raise IndexError(f"index {index} of {len(items)}")
    return items[index]
