"""What events explain of an object's contours, and how they gather on them: :mod:`tracking.validation.measures`, object by object."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.backends.filling import filled
from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import across, drift, inverse_depth, lens
from torchtrack.backends.numba.matching import patch
from torchtrack.backends.numba.parameters import QualitySettings
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import accelerates
from torchtrack.core.image_velocity import MovingObjects
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association import polarity, weights
from torchtrack.tracking.association.matches import Matches
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.motion.prediction import LOOKED_AT, Prediction
from torchtrack.tracking.validation import measures


@kernel(fastmath=FAST)
def measure(
    points_cam: Array,
    pixels: Array,
    normals: Array,
    mask: Array,
    kind: Array,
    resolved: Array,
    image_sizes: Array,
    velocity: Array,
    centre_cam: Array,
    intrinsics: Array,
    targets: Array,
    directions: Array,
    offsets: Array,
    is_near: Array,
    as_expected: Array,
    contour: Array,
    settings: QualitySettings,
    explained: Array,
    inliers: Array,
    spread: Array,
    agreement: Array,
) -> None:
    """What events say of each pose, point by point.

    Args:
        points_cam, pixels, normals, mask, kind, resolved: of contours: ``[b, 3, m]``, ``[b, 2, m]``, ``[b, 2, m]``, and ``[b, m]``.
        image_sizes: ``[b, 2]``, height and width.
        velocity: ``[b, 6]``, about ``centre_cam [b, 3]``.
        targets, directions, offsets, is_near, as_expected, contour: of matches: ``[b, 2, n]`` and ``[b, n]``.
        explained, inliers, spread, agreement: ``[b]``, filled: :class:`torchtrack.tracking.validation.measures.FitMeasures`.
    """
    counts = np.empty((settings.patches**2, 2))
    for b in range(len(mask)):
        inliers[b] = _count(targets[b], offsets[b], is_near[b], as_expected[b], settings, counts)
        spread[b] = _normal_spread(directions[b], offsets[b], is_near[b], settings.on_contour_px)
        agreement[b] = _texture_agreement(kind[b], resolved[b], contour[b], offsets[b], is_near[b], as_expected[b], settings)
        motion, of_lens = drift(velocity[b], centre_cam[b]), lens(intrinsics[b])
        total, count = 0, 0
        for i in range(mask.shape[1]):
            u, v = pixels[b, 0, i], pixels[b, 1, i]
            if not mask[b, i] or not (u >= 0 and v >= 0 and u < image_sizes[b, 1] and v < image_sizes[b, 0]):
                continue
            x, y, z = points_cam[b, 0, i], points_cam[b, 1, i], points_cam[b, 2, i]
            speed_u, speed_v = across(motion, x, y, z, inverse_depth(z), of_lens)
            if abs(normals[b, 0, i] * speed_u + normals[b, 1, i] * speed_v) > settings.min_speed_px_s:
                cell = patch(u, v, settings.patch_bits, settings.patches)
                on, near = counts[cell, 0], counts[cell, 1]
                total += 1
                count += on >= settings.min_on_contour and on + 1.0 > settings.least_ratio * (near + 2.0)
        explained[b] = count / total if total >= settings.min_moving_points else np.nan


@kernel()
def _count(targets: Array, offsets: Array, is_near: Array, as_expected: Array, settings: QualitySettings, counts: Array) -> float:
    """Count observations on and near contours in each patch of the image; the ratio of all near ones that is on them."""
    counts[:] = 0.0
    near = on = 0
    for i in range(len(offsets)):
        if not is_near[i]:
            continue
        away = abs(offsets[i])
        near += away < settings.around_px
        on += away < settings.on_contour_px
        if away < settings.smear_px:
            cell = patch(targets[0, i], targets[1, i], settings.patch_bits, settings.patches)
            counts[cell, 1] += as_expected[i]
            if away < settings.on_contour_px:
                counts[cell, 0] += as_expected[i]
    return on / near if near >= settings.min_observations else np.nan


@kernel()
def _normal_spread(directions: Array, offsets: Array, is_near: Array, on_contour_px: float) -> float:
    """How far the normals are spread of the contours of an object that something lies on."""
    count, cosine, sine = 0, 0.0, 0.0
    for i in range(len(offsets)):
        if is_near[i] and abs(offsets[i]) < on_contour_px:
            u, v = directions[0, i], directions[1, i]
            count += 1
            cosine += u * u - v * v
            sine += 2.0 * u * v
    return 0.5 * (count - np.sqrt(cosine * cosine + sine * sine)) / max(count, 1)


@kernel()
def _texture_agreement(
    kind: Array, resolved: Array, contour: Array, offsets: Array, is_near: Array, as_expected: Array, settings: QualitySettings
) -> float:
    """What observations on texture say of its darker side."""
    evidence, total = 0.0, 0.0
    for i in range(len(offsets)):
        weight = resolved[contour[i]]
        if is_near[i] and abs(offsets[i]) < settings.on_contour_px and kind[contour[i]] == settings.texture and weight > 0.0:
            evidence += weight * weight
            total += weight * (as_expected[i] - 0.5)
    return 0.5 + total / evidence if evidence >= settings.min_observations else np.nan


@kernel(fastmath=FAST)
def visible(pixels: Array, mask: Array, image_sizes: Array, ratio: Array) -> None:
    """Ratio of contour points in the image: :func:`tracking.validation.measures.visible_ratio`, of ``pixels [b, 2, m]`` and ``mask [b, m]``."""
    for b in range(len(mask)):
        total = seen = 0
        for i in range(mask.shape[1]):
            u, v = pixels[b, 0, i], pixels[b, 1, i]
            total += mask[b, i]
            seen += mask[b, i] and u >= 0 and v >= 0 and u < image_sizes[b, 1] and v < image_sizes[b, 0]
        ratio[b] = seen / max(total, 1)


@kernel()
def remember(darker_outside: Array, directions: Array, dark: Array, weights: Array, window_s: Array, memory_s: float, least_evidence: float) -> None:
    """What is remembered of sides with a window more: :func:`torchtrack.tracking.association.polarity.remembered`, in place.

    Args:
        darker_outside: ``[b, 8]``.
        directions: ``[b, 2, n]``; ``dark`` and ``weights [b, n]``; ``window_s [b]``.
        least_evidence: evidence that counts for half.
    """
    sums = np.empty((2, 8))
    for b in range(len(dark)):
        _sides(directions[b], dark[b], weights[b], sums)
        fresh = 1.0 - np.exp(-window_s[b] / memory_s)
        for k in range(8):
            gain = fresh * sums[1, k] / (sums[1, k] + least_evidence)
            darker_outside[b, k] += gain * (sums[0, k] / max(sums[1, k], 1e-3) - darker_outside[b, k])


@kernel()
def _sides(directions: Array, dark: Array, weights: Array, sums: Array) -> None:
    """Sums of what events on one object's contours say of their darker side, and of its evidence, by octant."""
    sums[:] = 0.0
    for i in range(len(dark)):
        if weights[i] != 0:
            which = octant(directions[0, i], directions[1, i])
            sums[0, which] += weights[i] * dark[i]
            sums[1, which] += weights[i] * abs(dark[i])


@kernel()
def octant(u: float, v: float) -> int:
    """The eighth of the plane that a direction points to: :func:`torchtrack.tracking.association.polarity.octant`."""
    return int(u > 0) + 2 * int(v > 0) + 4 * int(abs(u) > abs(v))


@kernel(fastmath=FAST)
def variance_across(
    points_cam: Array, normals: Array, mask: Array, covariance: Array, centre_cam: Array, intrinsics: Array, most: int, variance: Array
) -> None:
    """Mean variance of contours across themselves in the image (px²): of :meth:`torchtrack.tracking.motion.prediction.Prediction.sigma_px`.

    Args:
        points_cam, normals, mask: of contours: ``[b, 3, m]``, ``[b, 2, m]``, ``[b, m]``.
        covariance: ``[b, 6, 6]`` of the pose.
        most: points that are looked at, spread evenly over those that count.
        variance: ``[b]``, filled.
    """
    place, row = np.empty(mask.shape[1], np.int64), np.empty(6)
    for b in range(len(mask)):
        total = 0
        for i in range(mask.shape[1]):
            if mask[b, i]:
                place[total] = i
                total += 1
        looked_at, variance[b] = min(total, most), 0.0
        for j in range(looked_at):
            i = place[int(j * max(total / most, 1.0))]
            _gradient(points_cam[b, :, i], normals[b, :, i], centre_cam[b], intrinsics[b], row)
            for k in range(6):
                for m in range(6):
                    variance[b] += row[k] * covariance[b, k, m] * row[m] / looked_at


@kernel(fastmath=FAST)
def _gradient(point_cam: Array, normal: Array, centre_cam: Array, intrinsics: Array, row: Array) -> None:
    """How a point moves along its normal in the image with the pose: :func:`torchtrack.core.image_velocity.pose_jacobian`."""
    inverse = inverse_depth(point_cam[2])
    gx, gy = normal[0] * intrinsics[0] * inverse, normal[1] * intrinsics[1] * inverse
    gz = -(gx * point_cam[0] + gy * point_cam[1]) * inverse
    ax, ay, az = point_cam[0] - centre_cam[0], point_cam[1] - centre_cam[1], point_cam[2] - centre_cam[2]
    row[0], row[1], row[2] = ay * gz - az * gy, az * gx - ax * gz, ax * gy - ay * gx
    row[3], row[4], row[5] = gx, gy, gz


@accelerates(Prediction.sigma_px)
def sigma_px_numba(prediction: Prediction, contours: Contours) -> Float[Tensor, "b"]:
    """Point by point."""
    variance = contours.pixels.new_empty(len(contours.mask))
    seen = as_arrays(contours.points_cam.transpose(1, 2), contours.normals.transpose(1, 2), contours.mask)
    own = as_arrays(prediction.covariance[:, :6, :6], prediction.centre_cam, prediction.objects.intrinsics)
    variance_across(*seen, *own, LOOKED_AT, variance.numpy())
    return variance.sqrt()


@accelerates(measures.fit_measures)
def fit_measures_numba(
    contours: Contours, matches: Matches, objects: MovingObjects, image_sizes: Int[Tensor, "b 2"], config: TrackerConfig
) -> measures.FitMeasures:
    """Point by point."""
    measured = measures.FitMeasures(*contours.pixels.new_empty(4, len(contours.mask)))
    places = (values.transpose(1, 2) for values in (contours.points_cam, contours.pixels, contours.normals))
    shown = *places, contours.mask, contours.kind, contours.resolved, image_sizes
    moving = as_arrays(objects.velocity, objects.centre_cam, objects.intrinsics)
    sides = as_arrays(matches.targets.transpose(1, 2), matches.directions.transpose(1, 2))
    matched = *sides, *as_arrays(matches.offsets, matches.near, matches.as_expected, matches.contour)
    more = {"min_on_contour": measures.min_on_contour(config), "texture": int(ContourKind.TEXTURE)}
    settings = filled(QualitySettings, config.validation, measures, weights, **more)
    measure(*as_arrays(*shown), *moving, *matched, settings, *(values.numpy() for values in measured))
    return measured


@accelerates(measures.visible_ratio)
def visible_ratio_numba(contours: Contours, image_sizes: Int[Tensor, "b 2"]) -> Float[Tensor, "b"]:
    """Point by point."""
    ratio = contours.pixels.new_empty(len(contours.mask))
    visible(*as_arrays(contours.pixels.transpose(1, 2), contours.mask, image_sizes), ratio.numpy())
    return ratio


@accelerates(polarity.remembered)
def remembered_numba(
    darker_outside: Float[Tensor, "b 8"],
    directions: Float[Tensor, "b n 2"],
    dark: Float[Tensor, "b n"],
    weights: Float[Tensor, "b n"],
    window_s: Float[Tensor, "b"],
) -> Float[Tensor, "b 8"]:
    """Event by event."""
    after = darker_outside.clone(memory_format=torch.contiguous_format)
    remember(*as_arrays(after, directions.transpose(1, 2), dark, weights, window_s), polarity.PRIOR_S, polarity.LITTLE_EVIDENCE)
    return after
