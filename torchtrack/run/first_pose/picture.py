"""A picture of a first pose: the events after its time, and the contours at the pose on them."""

import numpy as np
import torch
from jaxtyping import UInt8

from torchtrack.config.tracker import TrackerConfig
from torchtrack.run.first_pose.start import Start
from torchtrack.run.first_pose.tracked import FirstPose
from torchtrack.tracking.objects import TrackedObjects
from torchtrack.tracking.validation.status import Status
from torchtrack.viz.contour_lines import contour_links
from torchtrack.viz.event_picture import FADING_S, SHOWN_US, soonest_event, with_ruler
from torchtrack.viz.overlay import OverlayObject, draw_overlay, enlargement


def draw_start(start: Start, pose: FirstPose, name: str) -> UInt8[np.ndarray, "h w 3"]:
    """The picture (BGR).

    Args:
        start: model, camera and events.
        pose: of the object, at the start.
        name: shown beside it.
    """
    camera, shown = start.camera, start.events.slice_time(start.at_us, start.at_us + SHOWN_US)
    pixels = torch.stack([shown.x, shown.y], 1).long().numpy()
    surface = soonest_event(pixels, shown.t_us.numpy(), start.at_us, (camera.width, camera.height))
    image = draw_overlay(surface, start.at_us, camera, [_contours(start, pose, name)], decay_s=FADING_S)
    return with_ruler(image, enlargement(camera.width))


def _contours(start: Start, pose: FirstPose, name: str) -> OverlayObject:
    tracked, none = TrackedObjects([start.model], start.camera, TrackerConfig()), np.zeros((0, 2))
    with torch.inference_mode():
        contours = tracked.objects.contours(pose.T_cam_obj[None].float(), tracked.config.contours)
    seen = contours.mask[0]
    pixels, normals = (values[0][seen].double().numpy() for values in (contours.pixels, contours.normals))
    status = Status.TRACKING if pose.quality >= 0.5 else Status.UNCERTAIN
    return OverlayObject(name, status, pose.quality, pixels, contour_links(pixels, normals), None, none, none, None)
