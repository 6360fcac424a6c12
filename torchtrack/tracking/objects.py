"""What a tracker is made for: the objects, the cameras that see them, and the settings; nothing of it changes."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.camera import Camera
from torchtrack.errors import ModelError
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.contour_source import ContourModel, group_by_model
from torchtrack.tracking.association.weighting_network import SilhouetteTrust, TrustNetwork, shipped_network
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.frontend.sensors import Sensors, sensor_tables
from torchtrack.tracking.frontend.tiles import SensorTiles
from torchtrack.tracking.motion.prediction import far_pose


class TrackedObjects(nn.Module):
    """The objects of a tracker, in its streams; arguments as those of :class:`torchtrack.tracking.tracker.Tracker`."""

    intrinsics: Tensor
    ideal_pixels: Tensor
    sensor_pixels: Tensor
    sensor_numbers: Tensor
    stream_index: Tensor
    image_sizes: Tensor
    centre_obj: Tensor
    half_extent: Tensor
    diameter_m: Tensor
    with_surface: Tensor
    far_pose: Tensor

    def __init__(
        self,
        objects: Sequence[ObjectModel],
        camera: Camera | Sequence[Camera],
        config: TrackerConfig | None = None,
        stream_index: Sequence[int] | None = None,
        dtype: torch.dtype = torch.float32,
        weighting_network: nn.Module | None = None,
    ) -> None:
        super().__init__()
        cameras = [camera] if isinstance(camera, Camera) else list(camera)
        self.config = config or TrackerConfig()
        self.object_names = tuple(model.name for model in objects)
        self.object_models, self.cameras, self.has_own_network = tuple(objects), tuple(cameras), weighting_network is not None
        streams = list(stream_index) if stream_index is not None else [0] * len(objects)
        check_setup(objects, cameras, streams, self.config)
        self._shared = len(set(streams)) < len(streams)
        self.image_size = (max(c.height for c in cameras), max(c.width for c in cameras))
        self.groups = nn.ModuleList(group_by_model(objects, self.config.contours))
        self.register_buffer("stream_index", torch.tensor(streams))
        self.register_buffer("image_sizes", torch.tensor([(cameras[s].height, cameras[s].width) for s in streams]))
        self.register_buffer("intrinsics", torch.stack([cameras[s].intrinsics() for s in streams]))
        for name, table in zip(("ideal_pixels", "sensor_pixels", "sensor_numbers"), sensor_tables(cameras), strict=True):
            self.register_buffer(name, table)
        self.tiles = SensorTiles(self.ideal_pixels)
        self.register_buffer("centre_obj", torch.stack([model.centre for model in objects]))
        self.register_buffer("half_extent", torch.stack([model.half_extent for model in objects]))
        self.register_buffer("diameter_m", torch.tensor([model.diameter_m for model in objects]))
        self.register_buffer("far_pose", far_pose(self.centre_obj))
        self.weighting_network = shipped_network(self.models, self.config.association) if weighting_network is None else weighting_network
        # On dense meshes no line of sight is followed.
        with_surface = torch.zeros(len(objects), dtype=torch.bool)
        for model in self.models:
            with_surface[model.members] = len(model.triangles) > 0
        self.register_buffer("with_surface", with_surface)
        self._any_surface = bool(with_surface.any())
        self.to(dtype)

    @property
    def models(self) -> list[ContourModel]:
        """The distinct models, with the objects that have each."""
        return [group for group in self.groups if isinstance(group, ContourModel)]

    @property
    def objects(self) -> ObjectBatch:
        """The objects as one batch."""
        shape = (self.streams, *self.image_size)
        own = self.intrinsics, self.centre_obj, self.half_extent, self.diameter_m, self.stream_index, self.image_sizes
        return ObjectBatch(self.models, *own, shape, self._shared)

    @property
    def sensors(self) -> Sensors:
        """The sensors that the objects are seen by."""
        return Sensors(self.ideal_pixels, self.sensor_pixels, self.sensor_numbers, self.stream_index, self.tiles)

    @property
    def on_surfaces(self) -> Tensor | None:
        """On which objects contours can be learned; None where on none."""
        return self.with_surface if self._any_surface else None

    @property
    def shows_all(self) -> bool:
        """Whether a window's events are kept that cannot have to do with the objects: a weighting network of one's own may look at any."""
        return self.weighting_network is not None and not isinstance(self.weighting_network, TrustNetwork | SilhouetteTrust)

    @property
    def looks_back(self) -> bool:
        """Whether anything needs the events of earlier windows: they are not kept for nothing."""
        return self.config.corners.max_corners > 0 or self.config.association.search == "guided" or self.weighting_network is not None

    @property
    def streams(self) -> int:
        """Number of event streams."""
        return len(self.ideal_pixels)


def check_setup(objects: Sequence[ObjectModel], cameras: Sequence[Camera], streams: Sequence[int], config: TrackerConfig) -> None:
    """Raise ``ValueError`` unless objects, cameras and streams fit together, and ``ModelError`` for a model without contours."""
    if not objects:
        raise ValueError("a tracker needs at least one object.")
    if len(streams) != len(objects):
        raise ValueError(f"stream_index needs one entry per object: got {len(streams)} for {len(objects)} objects.")
    if not all(0 <= s < len(cameras) for s in streams):
        raise ValueError(f"stream_index must be within the {len(cameras)} cameras given (one per stream), got {streams}.")
    for model in objects:
        if config.contours.source == "splat" and len(model.surface_points) == 0:
            raise ModelError(
                f"'{model.name}' has no surface to take splatted contours from: give a mesh, or set contours.source to 'mesh', which takes polylines."
            )
