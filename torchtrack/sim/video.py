"""Events of a given video, or of a folder of images, as an event camera in the place of the camera would have seen it.

Between two frames the picture is moved along its optical flow, so that nothing moves further than a set way at once; v2e
(Hu 2021) does the same with a learnt network. What a video does not hold, such as motion blurred away or clipped light,
no simulation brings back.
"""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from pydantic import Field, model_validator

from torchtrack.config.settings import ConfigPath, Settings
from torchtrack.core.atomic import atomic_path, check_writable
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.core.files import read_bytes
from torchtrack.errors import EventDataError, MissingFileError, UnknownFormatError
from torchtrack.io.reading import Progress
from torchtrack.sim.event_camera import EventCamera
from torchtrack.sim.sensor_profiles import EVENT_CAMERA_PROFILES, EventCameraConfig
from torchtrack.sim.surface import grey_reflectance

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_LUMA_BGR = np.array([0.0722, 0.7152, 0.2126], dtype=np.float32)
_LINEAR = grey_reflectance(np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)).astype(np.float32)
# Of all pixels, this share may move further than the way that is set: a single wrong flow vector should not cost frames.
_FLOW_PERCENTILE = 99.0
# Later than any clock, since 1970 or since the start.
_LARGEST_S = 1e11

Timed = tuple[int, Float[ndarray, "h w"]]


class VideoConfig(Settings):
    """Settings of ``torchtrack simulate --video``."""

    video: ConfigPath = Field(description="A video file, or a folder of images in the order of their names.")
    frames_per_second: float | None = Field(None, gt=0, le=1_000_000, description="Of the video; by default what the file says. Images need it.")
    timestamps: ConfigPath | None = Field(None, description="Text file: the time of each frame in seconds, first on its line; instead of a rate.")
    noise: Literal["ideal", "default", "realistic"] = Field("default", description="Event camera profile.")
    event_camera: EventCameraConfig | None = Field(None, description="Event camera parameters, instead of a profile.")
    interpolate: bool = Field(True, description="Move the picture along its flow between frames; else light changes in a straight line.")
    max_motion_px: float = Field(0.5, gt=0.01, le=10, description="Furthest way of the picture at once, pixels.")
    max_steps: int = Field(64, ge=1, le=1000, description="No more pictures than this from one frame to the next.")
    seed: int = Field(0, ge=0, le=2**31, description="Of thresholds and noise.")

    @model_validator(mode="after")
    def _one_clock(self) -> "VideoConfig":
        if self.timestamps is not None and self.frames_per_second is not None:
            raise ValueError("give timestamps or frames_per_second, not both")
        return self


def video_frames(config: VideoConfig) -> Iterator[Timed]:
    """Times (µs since the first frame) and luminances (linear, 0 to 1) of all frames.

    Raises:
        MissingFileError: if the video, or the file of times, is not there.
        UnknownFormatError: if it cannot be read, or its rate is not known.
        EventDataError: if the frames differ in size, times do not increase, or there are fewer times than frames.
    """
    size = None
    images = _images(config.video)
    times = _times_us(config)
    last_us = -1
    for image in images:
        t_us = next(times, None)
        if t_us is None or t_us <= last_us:
            raise EventDataError(f"'{config.timestamps}' must hold one time (s) per frame, increasing; after {last_us} µs came {t_us}.")
        if size is not None and image.shape != size:
            raise EventDataError(f"the frames of '{config.video}' differ in size: {image.shape[:2]} after {size[:2]}.")
        size, last_us = image.shape, t_us
        yield t_us, _LINEAR[image] @ _LUMA_BGR


def _images(path: Path) -> Iterator[ndarray]:
    """BGR images of a folder, or of a video file."""
    if path.is_dir():
        files = _image_files(path)
        if not files:
            raise MissingFileError(f"the folder '{path}' holds no images ({', '.join(_IMAGES)}).")
        for file in files:
            image = cv2.imread(str(file), cv2.IMREAD_COLOR)
            if image is None:
                raise UnknownFormatError(f"'{file}' cannot be read as an image.")
            yield image
        return
    video = _open_video(path)
    try:
        while (frame := video.read())[0]:
            yield frame[1]
    finally:
        video.release()


def _image_files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in _IMAGES)


def _open_video(path: Path) -> cv2.VideoCapture:
    if not path.is_file():
        raise MissingFileError(f"no video or folder of images at '{path}'. Check the path.")
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise UnknownFormatError(f"'{path}' cannot be read as a video. Use MP4, AVI or another format that OpenCV reads, or a folder of images.")
    return video


def _times_us(config: VideoConfig) -> Iterator[int]:
    """Times of the frames, µs since the first; without end where the rate is given."""
    if config.timestamps is None:
        rate = config.frames_per_second or _rate_of(config.video)
        number = 0
        while True:
            yield round(1e6 * number / rate)
            number += 1
    content = read_bytes(config.timestamps, "file of times", "text_bytes")
    try:
        lines = [line.split() for line in content.decode("utf-8").splitlines()]
        seconds = np.array([float(words[0]) for words in lines if words and not words[0].startswith("#")])
    except ValueError as error:
        raise EventDataError(f"'{config.timestamps}': every line must start with a time in seconds ({error}).") from error
    unsound: np.ndarray = ~(np.abs(seconds) <= _LARGEST_S)
    if unsound.any():
        raise EventDataError(
            f"'{config.timestamps}' has a time of {seconds[unsound][0]} s. Give each frame's time in seconds, as a number up to {_LARGEST_S:g}."
        )
    yield from (round(1e6 * (second - seconds[0])) for second in seconds.tolist())


def _rate_of(path: Path) -> float:
    rate = 0.0
    if path.is_file():
        video = _open_video(path)
        rate = float(video.get(cv2.CAP_PROP_FPS))
        video.release()
    if not 0 < rate < 1e6:
        raise UnknownFormatError(f"how many frames per second '{path}' has is not known. Give frames_per_second (--fps) or timestamps.")
    return rate


def between(first: Float[ndarray, "h w"], second: Float[ndarray, "h w"], config: VideoConfig) -> Iterator[tuple[float, Float[ndarray, "h w"]]]:
    """Pictures after the first frame up to the second, each with the share of the time that has passed."""
    if not config.interpolate:
        yield 1.0, second
        return
    still = np.zeros((*first.shape, 2), dtype=np.float32)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(_for_flow(first), _for_flow(second), still)
    furthest = float(np.percentile(np.linalg.norm(flow, axis=-1), _FLOW_PERCENTILE))
    steps = min(config.max_steps, max(1, int(np.ceil(furthest / config.max_motion_px))))
    v, u = np.mgrid[: first.shape[0], : first.shape[1]].astype(np.float32)
    for step in range(1, steps):
        share = step / steps
        old, new = (
            cv2.remap(image, u + part * flow[..., 0], v + part * flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for image, part in ((first, np.float32(-share)), (second, np.float32(1 - share)))
        )
        yield share, np.float32(1 - share) * old + np.float32(share) * new
    yield 1.0, second


def _for_flow(luminance: Float[ndarray, "h w"]) -> ndarray:
    return np.rint(255 * np.sqrt(luminance.clip(0, 1))).astype(np.uint8)


def events_of_video(config: VideoConfig) -> Iterator[tuple[int, tuple[int, int], EventBatch]]:
    """Time (µs) of each frame but the first, the size (width, height), and the events since the frame before.

    Raises:
        MissingFileError, UnknownFormatError, EventDataError: as :func:`video_frames`.
    """
    camera = state = None
    for (start_us, first), (end_us, second) in pairwise(video_frames(config)):
        height, width = first.shape
        if camera is None or state is None:
            camera = EventCamera(config.event_camera or EVENT_CAMERA_PROFILES[config.noise], width, height, config.seed)
            state = camera.start(torch.from_numpy(first), start_us)
        batches = []
        for share, picture in between(first, second, config):
            t_us = start_us + max(1, round(share * (end_us - start_us)))
            if t_us > state.frame_us:
                state, events = camera.step(state, torch.from_numpy(np.ascontiguousarray(picture)), t_us)
                batches.append(events)
        yield end_us, (width, height), concatenate(batches)


def frame_count(config: VideoConfig) -> int | None:
    """How many frames a video has, as its file or the files of its folder say; None where they do not."""
    if config.video.is_dir():
        return len(_image_files(config.video))
    video = _open_video(config.video)
    count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    video.release()
    return count if count > 0 else None


def write_video_events(config: VideoConfig, path: Path, progress: Progress | None = None) -> int:
    """Write the events of a video as ``.npz`` (``t x y p width height``); returns how many there are.

    Args:
        config: the video, and how it is seen.
        path: of the file to write.
        progress: called with the share of the frames that is done, where their number is known.

    Raises:
        MissingFileError, UnknownFormatError, EventDataError: as :func:`video_frames`; also if ``path`` is not a ``.npz`` file.
        OutputError: if it cannot be written.
    """
    if path.suffix != ".npz":
        raise EventDataError(f"events of a video are written to a .npz file, got '{path}'.")
    check_writable(path)
    frames = frame_count(config) if progress is not None else None
    parts: list[tuple[int, tuple[int, int], EventBatch]] = []
    for part in events_of_video(config):
        parts.append(part)
        if progress is not None and frames is not None:
            progress(min((len(parts) + 1) / frames, 1.0))
    if not parts:
        raise EventDataError(f"'{config.video}' holds fewer than two frames.")
    events = concatenate([batch for _, _, batch in parts])
    width, height = parts[0][1]
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(
            stream,
            t=events.t_us.numpy(),
            x=events.x.numpy().astype(np.uint16),
            y=events.y.numpy().astype(np.uint16),
            p=events.polarity.numpy().astype(np.uint8),
            width=np.int64(width),
            height=np.int64(height),
        )
    return len(events)
