"""What events explain of an object's contours, and how they gather on them: :mod:`tracking.validation.measures`, object by object."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.backends.filling import filled
from torchtrack.backends.numba.arrays import ContourArrays, MovingArrays, as_arrays, contour_arrays, moving_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import across, drift, inverse_depth, lens, slope_of
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


class MatchedArrays(NamedTuple):
    """Matches: ``[b, 2, n]``, and ``[b, n]``; or of one object."""

    targets: Array
    directions: Array
    offsets: Array
    is_near: Array
    as_expected: Array
    contour: Array


class FitArrays(NamedTuple):
    """What events say of each pose, ``[b]``: :class:`torchtrack.tracking.validation.measures.FitMeasures` by its fields."""

    measured_ratio: Array
    inlier_ratio: Array
    normal_spread: Array
    texture_agreement: Array
    visible_ratio: Array


class Visible(NamedTuple):
    """Contour points as they show, how far each is resolved, ``[b, m]``, and the sizes (height, width) of images, ``[b, 2]``."""

    shown: ContourArrays
    resolved: Array
    image_sizes: Array


@kernel(fastmath=FAST)
def measure(contours: Visible, moving: MovingArrays, matches: MatchedArrays, settings: QualitySettings, measured: FitArrays) -> None:
    """What events say of each pose, point by point."""
    (points_cam, pixels, normals, mask, kind), resolved, image_sizes = contours
    moving, matches, measured = MovingArrays(*moving), MatchedArrays(*matches), FitArrays(*measured)
    counts = np.empty((settings.patches**2, 2))
    for b in range(len(mask)):
        own = _matched_of(matches, b)
        measured.inlier_ratio[b] = _count(own, settings, counts)
        measured.normal_spread[b] = _normal_spread(own, settings.on_contour_px)
        measured.texture_agreement[b] = _texture_agreement(kind[b], resolved[b], own, settings)
        motion, of_lens = drift(moving.velocity[b], moving.centre_cam[b]), lens(moving.intrinsics[b])
        points = visible = total = count = 0
        height, width = image_sizes[b, 0], image_sizes[b, 1]
        for i in range(mask.shape[1]):
            u, v = pixels[b, 0, i], pixels[b, 1, i]
            points += mask[b, i]
            if not mask[b, i] or not (u >= 0 and v >= 0 and u < width and v < height):
                continue
            visible += 1
            x, y, z = points_cam[b, 0, i], points_cam[b, 1, i], points_cam[b, 2, i]
            speed_u, speed_v = across(motion, x, y, z, inverse_depth(z), of_lens)
            if abs(normals[b, 0, i] * speed_u + normals[b, 1, i] * speed_v) > settings.min_speed_px_s:
                cell = patch(u, v, settings.patch_bits, settings.patches)
                on, near = counts[cell, 0], counts[cell, 1]
                total += 1
                count += on >= settings.min_on_contour and on + 1.0 > settings.least_ratio * (near + 2.0)
        measured.measured_ratio[b] = count / total if total >= settings.min_moving_points else np.nan
        measured.visible_ratio[b] = visible / max(points, 1)


@kernel()
def _matched_of(matches: MatchedArrays, b: int) -> MatchedArrays:
    """The matches of one object."""
    m = matches
    return MatchedArrays(m.targets[b], m.directions[b], m.offsets[b], m.is_near[b], m.as_expected[b], m.contour[b])


@kernel()
def _count(matches: MatchedArrays, settings: QualitySettings, counts: Array) -> float:
    """Count observations on and near contours in each patch of the image; the ratio of all near ones that is on them."""
    targets, _, offsets, is_near, as_expected, _ = matches
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
def _normal_spread(matches: MatchedArrays, on_contour_px: float) -> float:
    """How far the normals are spread of the contours of an object that something lies on."""
    directions, offsets, is_near = matches.directions, matches.offsets, matches.is_near
    count, cosine, sine = 0, 0.0, 0.0
    for i in range(len(offsets)):
        if is_near[i] and abs(offsets[i]) < on_contour_px:
            u, v = directions[0, i], directions[1, i]
            count += 1
            cosine += u * u - v * v
            sine += 2.0 * u * v
    return 0.5 * (count - np.sqrt(cosine * cosine + sine * sine)) / max(count, 1)


@kernel()
def _texture_agreement(kind: Array, resolved: Array, matches: MatchedArrays, settings: QualitySettings) -> float:
    """What observations on texture say of its darker side."""
    _, _, offsets, is_near, as_expected, contour = matches
    evidence, total = 0.0, 0.0
    for i in range(len(offsets)):
        weight = resolved[contour[i]]
        if is_near[i] and abs(offsets[i]) < settings.on_contour_px and kind[contour[i]] == settings.texture and weight > 0.0:
            evidence += weight * weight
            total += weight * (as_expected[i] - 0.5)
    return 0.5 + total / evidence if evidence >= settings.min_observations else np.nan


class Sides(NamedTuple):
    """What events say of the darker side of contours: normals ``[b, 2, n]``, sides, and weights, ``[b, n]``."""

    directions: Array
    dark: Array
    weights: Array


@kernel()
def remember(darker_outside: Array, sides: Sides, window_s: Array, memory_s: float, least_evidence: float) -> None:
    """What is remembered of sides with a window more: :func:`torchtrack.tracking.association.polarity.remembered`, in place.

    Args:
        darker_outside: ``[b, 8]``.
        window_s: ``[b]``.
        least_evidence: evidence that counts for half.
    """
    (directions, dark, weights), sums = sides, np.empty((2, 8))
    for b in range(len(dark)):
        _add_up(directions[b], dark[b], weights[b], sums)
        fresh = 1.0 - np.exp(-window_s[b] / memory_s)
        for k in range(8):
            gain = fresh * sums[1, k] / (sums[1, k] + least_evidence)
            darker_outside[b, k] += gain * (sums[0, k] / max(sums[1, k], 1e-3) - darker_outside[b, k])


@kernel()
def _add_up(directions: Array, dark: Array, weights: Array, sums: Array) -> None:
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
def variance_across(contours: ContourArrays, covariance: Array, centre_cam: Array, intrinsics: Array, most: int, variance: Array) -> None:
    """Mean variance of contours across themselves in the image (px²): of :meth:`torchtrack.tracking.motion.prediction.Prediction.sigma_px`.

    Args:
        covariance: ``[b, 6, 6]`` of the pose.
        most: points that are looked at, spread evenly over those that count.
        variance: ``[b]``, filled.
    """
    points, _, normals, mask, _ = contours
    place = np.empty(mask.shape[1], np.int64)
    for b in range(len(mask)):
        total = 0
        for i in range(mask.shape[1]):
            if mask[b, i]:
                place[total] = i
                total += 1
        looked_at, variance[b], centre, focal_px = min(total, most), 0.0, centre_cam[b], (intrinsics[b, 0], intrinsics[b, 1])
        for j in range(looked_at):
            i = place[int(j * max(total / most, 1.0))]
            row = slope_of((points[b, 0, i], points[b, 1, i], points[b, 2, i]), (normals[b, 0, i], normals[b, 1, i]), centre, focal_px)
            for k in range(6):
                for m in range(6):
                    variance[b] += row[k] * covariance[b, k, m] * row[m] / looked_at


@accelerates(Prediction.sigma_px)
def sigma_px_numba(prediction: Prediction, contours: Contours) -> Float[Tensor, "b"]:
    """Point by point."""
    variance = contours.pixels.new_empty(len(contours.mask))
    own = as_arrays(prediction.covariance[:, :6, :6], prediction.centre_cam, prediction.objects.intrinsics)
    variance_across(contour_arrays(contours), *own, LOOKED_AT, variance.numpy())
    return variance.sqrt()


@accelerates(measures.fit_measures)
def fit_measures_numba(
    contours: Contours, matches: Matches, objects: MovingObjects, image_sizes: Int[Tensor, "b 2"], config: TrackerConfig
) -> measures.FitMeasures:
    """Point by point."""
    measured = measures.FitMeasures(*contours.pixels.new_empty(5, len(contours.mask)))
    visible = contour_arrays(contours), *as_arrays(contours.resolved, image_sizes)
    sides = matches.targets.transpose(1, 2), matches.directions.transpose(1, 2)
    matched = as_arrays(*sides, matches.offsets, matches.near, matches.as_expected, matches.contour)
    more = {"min_on_contour": measures.min_on_contour(config), "texture": int(ContourKind.TEXTURE)}
    settings = filled(QualitySettings, config.validation, measures, weights, **more)
    measure(visible, moving_arrays(objects), matched, settings, as_arrays(*measured))
    return measured


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
    sides = as_arrays(directions.transpose(1, 2), dark, weights)
    remember(after.numpy(), sides, *as_arrays(window_s), polarity.PRIOR_S, polarity.LITTLE_EVIDENCE)
    return after
