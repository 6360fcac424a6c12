"""Settings of one run: what is tracked, where from, how, and where the results go."""

from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import torch
from pydantic import BeforeValidator, Field, model_validator

from torchtrack.config.events import EventsConfig, EventSourcePath, TimeUnit
from torchtrack.config.merge import merged
from torchtrack.config.presets import PresetName, preset
from torchtrack.config.settings import ConfigPath, Settings
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.camera import DistortionModel
from torchtrack.core.limits import Limits, current_limits
from torchtrack.core.pose_checks import check_pose, quaternion_problem
from torchtrack.core.pose_types import as_pose_matrices

Models = Literal["textured", "geometry"]
Row = tuple[float, float, float, float]
# What says more about a file of poses.
_OF_TRAJECTORIES = ("name", "time_unit", "frame_us", "T_cam_world")


def _as_rows(pose: Any) -> Any:
    """Rows of numbers, where it is a pose of another library, an array or a tensor; else as it is."""
    return pose if pose is None or isinstance(pose, list | tuple) else as_pose_matrices(pose).tolist()


Matrix = Annotated[tuple[Row, Row, Row, Row], BeforeValidator(_as_rows)]


class PoseConfig(Settings):
    """An initial pose ``T_cam_obj``, in one of three ways."""

    matrix: Matrix | None = Field(None, description="The 4x4 matrix, row by row.")
    translation_m: tuple[float, float, float] | None = Field(None, description="Position of the object's origin in the camera frame (m).")
    quaternion_xyzw: Row = Field((0.0, 0.0, 0.0, 1.0), description="Rotation beside translation_m, as a quaternion x, y, z, w of norm 1.")
    trajectory: ConfigPath | None = Field(None, description="A file of poses (TUM, CSV, BOP, OptiTrack); the pose is taken at the start time.")
    name: str | None = Field(None, description="Which of several in the file of poses: the rigid body of OptiTrack, the obj_id of BOP.")
    frame_us: int | None = Field(None, ge=1, description="Time from one image to the next (µs), where the file of poses numbers images, as BOP does.")
    T_cam_world: Matrix | None = Field(None, description="Where the camera is, row by row, if the file has poses T_world_obj in a frame of its own.")
    time_unit: TimeUnit | None = Field(None, description="Unit of the file's times: s, ms, us or ns; by default s, or as its first line says.")

    @model_validator(mode="after")
    def _one_way(self) -> "PoseConfig":
        ways = [name for name in ("matrix", "translation_m", "trajectory") if getattr(self, name) is not None]
        if len(ways) != 1:
            raise ValueError(f"give exactly one of matrix, translation_m (with quaternion_xyzw) or trajectory; got {' and '.join(ways) or 'none'}")
        if self.trajectory is None and any(getattr(self, name) is not None for name in _OF_TRAJECTORIES):
            raise ValueError(f"{', '.join(_OF_TRAJECTORIES[:-1])} and {_OF_TRAJECTORIES[-1]} are of a trajectory; leave them out")
        return self

    @model_validator(mode="after")
    def _rigid_camera(self) -> "PoseConfig":
        if self.T_cam_world is not None:
            check_pose(torch.tensor(self.T_cam_world, dtype=torch.float64), "T_cam_world")
        return self

    @model_validator(mode="after")
    def _unit_quaternion(self) -> "PoseConfig":
        problem = quaternion_problem(self.quaternion_xyzw)
        if problem is not None:
            raise ValueError(f"quaternion_xyzw: {problem}")
        return self


class ObjectConfig(Settings):
    """One object: its model and where it is at first."""

    label: str = Field(min_length=1, pattern=r"^[\w.-]+$", description="Name of the object in outputs; for a sequence, one of its labels.")
    mesh: ConfigPath | None = Field(None, description="PLY, OBJ, STL, GLB or OFF file; by default the sequence's own.")
    polylines: ConfigPath | None = Field(None, description="File of 3D polylines, instead of a mesh.")
    unit: Literal["m", "cm", "mm", "inch"] = Field("m", description="Unit of the model's coordinates.")
    scale: float = Field(1.0, gt=0, le=1e6, description="Enlargement of the model.")
    centre: bool = Field(False, description="The middle of the model's bounding box is the origin that its poses are of.")
    initial_pose: PoseConfig | None = Field(None, description="Pose at the start; by default the sequence's ground truth.")

    @model_validator(mode="after")
    def _one_model(self) -> "ObjectConfig":
        if self.mesh is not None and self.polylines is not None:
            raise ValueError("give mesh or polylines, not both")
        if self.mesh is None and self.polylines is None and (self.unit, self.scale, self.centre) != ("m", 1.0, False):
            raise ValueError("unit, scale and centre are of a mesh or polylines given here: a sequence's own model is as its poses are")
        return self


class CameraConfig(Settings):
    """Intrinsics, from a calibration file or inline; a sequence brings its own."""

    calibration: ConfigPath | None = Field(None, description="Calibration file, for example the text 'fx fy cx cy k1 k2 p1 p2 k3'.")
    fx: float | None = Field(None, gt=0, description="Focal length (px).")
    fy: float | None = Field(None, gt=0, description="Focal length (px).")
    cx: float | None = Field(None, description="Principal point (px).")
    cy: float | None = Field(None, description="Principal point (px).")
    width: int | None = Field(None, ge=1, le=65_536, description="Sensor width (px), where the calibration does not say it.")
    height: int | None = Field(None, ge=1, le=65_536, description="Sensor height (px), where the calibration does not say it.")
    name: str | None = Field(None, description="Which camera of a calibration of several: its key, such as cam0, or its topic.")
    distortion_model: DistortionModel | None = Field(None, description="Lens model, as in OpenCV; none by default, or as the calibration says.")
    distortion: tuple[float, ...] = Field((), description="Its coefficients.")

    @model_validator(mode="after")
    def _complete(self) -> "CameraConfig":
        missing = [name for name in ("fx", "fy", "cx", "cy", "width", "height") if getattr(self, name) is None]
        if self.calibration is None and missing:
            raise ValueError(f"give a calibration file, or fx, fy, cx, cy, width and height; {', '.join(missing)} missing")
        if self.calibration is not None and not {"fx", "fy", "cx", "cy"} <= set(missing):
            raise ValueError("give a calibration file or fx, fy, cx and cy, not both")
        if self.calibration is not None and self.distortion:
            raise ValueError("distortion: the calibration file says it. Leave it out, or give all of the camera here")
        if self.calibration is None and self.name is not None:
            raise ValueError("name: it is of a camera in a calibration file. Leave it out")
        if self.distortion and self.distortion_model is None:
            raise ValueError("distortion_model: say which model the coefficients of distortion are of, plumb_bob or fisheye")
        return self


class OverlayConfig(Settings):
    """The video of what was tracked."""

    enabled: bool = Field(True, description="Write overlay.mp4 and stills.")
    frames_per_second: float = Field(30.0, gt=0, le=240, description="Frames per second of the video.")
    slow_motion: float = Field(4.0, ge=0.01, le=1000, description="How many times slower than life the video plays.")
    stills: int = Field(4, ge=0, le=100, description="PNG stills, taken evenly over the video.")


class RosConfig(Settings):
    """What is written for ROS 2."""

    bag: bool = Field(False, description="Also write poses.mcap: poses and transforms as messages, for Foxglove and rosbag2 (extra ros).")


class TrackingConfig(Settings):
    """How objects are tracked: preset, tracker, arithmetic."""

    preset: PresetName = Field("default", description="Method, and tracker settings to start from.")
    tracker: TrackerConfig = Field(TrackerConfig(), description="Tracker settings that differ from the preset.")
    device: str = Field("cpu", pattern=r"^(cpu|cuda(:\d+)?)$", description="Where the tracker runs: cpu, cuda or cuda:N.")
    dtype: Literal["float32", "float64"] = Field("float32", description="Floating type of the tracker.")
    kernels: bool = Field(True, description="Use Numba's kernels on a CPU, where Numba is installed: a step takes less than half the time.")
    compiled: bool = Field(False, description="Compile the tracker: a step takes half the time, the start a few minutes. Needs a C++ compiler.")

    @model_validator(mode="before")
    @classmethod
    def _start_from_preset(cls, values: Any) -> Any:
        """Lay the given tracker settings over those of the preset."""
        tracker = values.get("tracker", {}) if isinstance(values, dict) else None
        if not isinstance(tracker, dict):
            return values
        name = values.get("preset", "default")
        # An unknown preset is reported by its own field.
        base = preset(name).model_dump() if name in get_args(PresetName) else {}
        return {**values, "tracker": merged(base, tracker)}


class RunConfig(TrackingConfig):
    """Settings of ``torchtrack track``."""

    source: EventSourcePath = Field(description="Event file, sequence, or live: dv://HOST:PORT, evk4://, davis://, ros:///TOPIC or stdin:// (EVT3).")
    events: EventsConfig = EventsConfig()
    objects: tuple[ObjectConfig, ...] = Field((), description="Objects to track; none given: all objects of the sequence.")
    camera: CameraConfig | None = Field(None, description="The camera; a sequence brings its own.")
    start_us: int | None = Field(None, description="Time of the initial pose, in stream time (µs); by default the start of the stream.")
    end_us: int | None = Field(None, description="Tracking ends here, in stream time (µs); by default with the stream.")
    sensor_latency_us: int = Field(
        0, ge=-1_000_000, le=1_000_000, description="How late the events' time stamps are against the poses' clock (µs); taken off."
    )
    models: Models = Field("textured", description="Use a sequence's textured models where it has them, or geometry alone.")
    threads: int = Field(1, ge=1, le=256, description="Threads of the tracker on the CPU.")
    output: ConfigPath = Field(
        default_factory=lambda: Path.cwd() / "outputs" / "track", description="Folder for the results; by default in the working folder."
    )
    overlay: OverlayConfig = OverlayConfig()
    limits: Limits = Field(default_factory=current_limits, description="How large files may be.")
    ros: RosConfig = RosConfig()
    alignment: bool = Field(False, description="Measure how far events lie from the contours, at the tracked and at the initial pose.")
    reference_angular_velocity: ConfigPath | None = Field(
        None, description="Text file of three numbers, for the summary (a camera turns the other way)."
    )

    @model_validator(mode="after")
    def _consistent(self) -> "RunConfig":
        labels = [obj.label for obj in self.objects]
        if duplicates := {label for label in labels if labels.count(label) > 1}:
            raise ValueError(f"objects: labels must differ; {', '.join(sorted(duplicates))} given more than once")
        if self.start_us is not None and self.end_us is not None and self.end_us <= self.start_us:
            raise ValueError(f"end_us must be after start_us; got {self.end_us} and {self.start_us}")
        return self
