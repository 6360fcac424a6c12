"""Sequences in one HDF5 file: events, camera, object models and ground truth.

The file reads as DSEC's do (see :mod:`torchtrack.io.writers.hdf5`), with more in it:

============================= ==========================================================================
attribute ``format``          ``torchtrack-sequence``; ``version`` is 1; ``width`` and ``height`` of the sensor; ``meta``: JSON
``events/{x,y,t,p}``          events: pixels (uint16), µs from ``t_offset`` on (int64, sorted), polarity (uint8, 1 = brighter)
``events/source``             optional, int16: number of the object or occluder an event is from, -1 background, -2 noise
``camera/K``                  3x3; ``camera/distortion``, with the attribute ``model``, as in OpenCV
``objects/LABEL``             in order of the attribute ``index``
``objects/LABEL/mesh``        the bytes of a model file, whose kind (``.ply``, …) is in the attribute ``suffix``; in metres
``objects/LABEL/textured``    optional: the same with texture
``objects/LABEL/poses``       optional, ``[P, 4, 4]``: object to camera; times ``pose_t`` ``[P]`` in µs, absolute
``extra/NAME``                optional: the arrays :attr:`torchtrack.io.Sequence.extra`, such as ``velocity``
============================= ==========================================================================
"""

import json
import shutil
import tempfile
import weakref
from collections.abc import Iterator, Mapping
from collections.abc import Sequence as ListOf
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from torchtrack.config.events import ReadingConfig
from torchtrack.core.camera import Camera
from torchtrack.core.files import is_file
from torchtrack.errors import CalibrationError, EventDataError, PoseError
from torchtrack.io.event_file import DEFAULT_CHOICES
from torchtrack.io.hdf5 import HDF5_MAGIC, Hdf5Events, open_hdf5
from torchtrack.io.hdf5_storage import check_link, check_whole
from torchtrack.io.sequence_types import Sequence, SequenceObject
from torchtrack.io.trajectory import Trajectory
from torchtrack.io.writers.hdf5 import Hdf5Writer, append

_FORMAT, _VERSION = "torchtrack-sequence", 1
_PARTS = {"camera", "objects", "extra"}


def is_container(path: Path) -> bool:
    """Whether a file is a sequence in HDF5."""
    if not is_file(path):
        return False
    with path.open("rb") as stream:
        if stream.read(len(HDF5_MAGIC)) != HDF5_MAGIC:
            return False
    with open_hdf5(path) as file:
        return bool(file.attrs.get("format") == _FORMAT)


def read_container(path: Path, strict: bool = False, *, choices: ReadingConfig = DEFAULT_CHOICES) -> Sequence:
    """Read a sequence in HDF5; its events stay on disk until they are streamed.

    ``choices`` say how its events are read; ``strict``: what is wrong in the stream is an error. Model files are put into a temporary
    folder, which goes with the object that names it.

    Raises:
        EventDataError: if something is missing, damaged or of the wrong shape.
        CalibrationError: if the camera makes no sense.
        PoseError: if the ground truth is not rigid, or its times do not increase.
    """
    events = Hdf5Events(path, strict=strict, choices=choices)
    with open_hdf5(path) as file:
        if file.attrs.get("version") != _VERSION:
            raise EventDataError(
                f"'{path}' is a sequence of version {file.attrs.get('version')}, but version {_VERSION} is known. Update torchtrack."
            )
        _check_arrays(file, path)
        try:
            camera = _read_camera(file, events)
            groups = sorted(file["objects"].items(), key=lambda item: int(item[1].attrs["index"]))
            objects = tuple(_read_object(path, label, group) for label, group in groups)
            meta = json.loads(str(file.attrs.get("meta", "{}")))
            extra = {name: _extra(array) for name, array in file.get("extra", {}).items()}
        except (CalibrationError, PoseError) as error:
            raise type(error)(f"'{path}': {error}") from error
    return Sequence(path.stem, events, camera, objects, meta if isinstance(meta, dict) else {"meta": meta}, extra)


def _check_arrays(file: h5py.File, path: Path) -> None:
    """Refuse arrays beside the events that are in other files, or too large to be read whole."""
    for part in _PARTS & set(file):
        check_link(file, part, path)
        unvisited = [file[part]]
        while unvisited:
            place = unvisited.pop()
            if isinstance(place, h5py.Dataset):
                check_whole(place, path)
                continue
            for name in place:
                check_link(place, name, path)
                if not isinstance(place.get(name, getlink=True), h5py.SoftLink):
                    unvisited.append(place[name])


def _extra(array: h5py.Dataset) -> np.ndarray:
    return np.array(array.asstr()[()], dtype=np.str_) if h5py.check_string_dtype(array.dtype) else array[()]


def _read_camera(file: h5py.File, events: Hdf5Events) -> Camera:
    group = file["camera"]
    distortion = group.get("distortion")
    model, coefficients = ("none", ()) if distortion is None else (str(distortion.attrs["model"]), tuple(np.ravel(distortion[()]).tolist()))
    return Camera.from_matrix(group["K"][()], events.width, events.height, model, coefficients)


def _read_object(path: Path, label: str, group: h5py.Group) -> SequenceObject:
    truth = None
    if "poses" in group:
        truth = Trajectory(torch.from_numpy(group["pose_t"][()]), torch.from_numpy(group["poses"][()]))
    folder = Path(tempfile.mkdtemp(prefix="torchtrack-"))
    files: dict[str, Path | None] = {"mesh": None, "textured": None}
    for name in files:
        if name in group:
            # Nothing but the suffix comes from the file: a path could lead anywhere.
            suffix = Path(f"model{group[name].attrs['suffix']}").suffix
            files[name] = folder / f"{path.stem}_{name}{suffix}"
            (folder / f"{path.stem}_{name}{suffix}").write_bytes(group[name][()].tobytes())
    if files["mesh"] is None:
        raise EventDataError(f"'{path}': the object '{label}' has no mesh.")
    read = SequenceObject(label, files["mesh"], files["textured"], truth)
    weakref.finalize(read, shutil.rmtree, folder, ignore_errors=True)
    return read


class ContainerWriter(Hdf5Writer):
    """Writes a sequence in HDF5.

    Args:
        path: the file.
        camera: the camera.
        objects: labels, model files and true poses.
        meta: what JSON can hold.
        extra: further arrays.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        objects: ListOf[SequenceObject] = (),
        meta: dict[str, Any] | None = None,
        extra: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        super().__init__(path, camera.width, camera.height)
        self.file.attrs.update({"format": _FORMAT, "version": _VERSION, "meta": json.dumps(meta or {})})
        self.file["camera/K"] = np.asarray(camera.matrix, np.float64)
        if camera.distortion_model != "none":
            self.file["camera/distortion"] = np.asarray(camera.distortion, np.float64)
            self.file["camera/distortion"].attrs["model"] = camera.distortion_model
        group = self.file.create_group("objects")
        for index, obj in enumerate(objects):
            _write_object(group, index, obj)
        for name, values in (extra or {}).items():
            self.file[f"extra/{name}"] = values.astype(h5py.string_dtype()) if values.dtype.kind == "U" else values

    def annotate(self, source: np.ndarray) -> None:
        """Append, for the events written last, the number of the object each is from.

        Raises:
            EventDataError: if there is not one number per event.
        """
        if "source" not in self.file["events"]:
            self.file.create_dataset("events/source", (0,), np.int16, maxshape=(None,), chunks=(1 << 16,))
        array = self.file["events/source"]
        append(array, source)
        if array.shape[0] != self._count:
            raise EventDataError(f"'source' has {array.shape[0]} entries for {self._count} events. Annotate every batch after it is written.")


def _write_object(group: h5py.Group, index: int, obj: SequenceObject) -> None:
    of_object = group.create_group(obj.label)
    of_object.attrs["index"] = index
    for name, file in (("mesh", obj.mesh_path), ("textured", obj.textured_path)):
        if file is not None:
            of_object[name] = np.frombuffer(file.read_bytes(), np.uint8)
            of_object[name].attrs["suffix"] = file.suffix
    if obj.ground_truth is not None:
        of_object["poses"] = obj.ground_truth.T_cam_obj.cpu().numpy()
        of_object["pose_t"] = obj.ground_truth.t_us.cpu().numpy()


def read_source(path: Path, max_events: int) -> Iterator[np.ndarray]:
    """The numbers of the objects that events are from, in parts of ``max_events``; nothing where they are not stored."""
    with open_hdf5(path) as file:
        array = file.get("events/source")
        for start in range(0, 0 if array is None else array.shape[0], max_events):
            yield array[start : start + max_events]
