"""Whether distortion coefficients can describe a real lens, and whether this project's lens model can take them.

The model is Brown–Conrady with k1, k2, p1, p2, k3. Coefficients of another model, cut off or read in another order,
would bend every image a little wrongly, and nothing later would notice.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.brown_conrady import distort, distortion_jacobian
from genre_tasks.logs.findings import Finding, Severity
from genre_tasks.logs.types import Float64, Lens

_MODEL = "k1, k2, p1, p2, k3"
_COUNT = 5
_REMEDY = f"Undistort the images and leave the coefficients out, or calibrate with {_MODEL} alone."
# What files name a lens model by, and what stands for Brown–Conrady there: ROS, OpenCV, COLMAP, nerfstudio, Kalibr.
_MODEL_KEYS = ("distortion_model", "camera_model", "model")
_KNOWN_MODELS = ("brown_conrady", "plumb_bob", "radtan", "opencv", "pinhole", "simple_pinhole", "perspective", "none")
_OTHER_MODELS = ("fisheye", "equi", "kannala", "kb4", "thin_prism", "rational", "omni", "mei", "ucm", "sphere", "theta")
_DISTORTION_KEY = "distortion"
# Where tools put the coefficients; other readers than those of posed images read the first alone.
_DISTORTION_NAMES = (
    _DISTORTION_KEY,
    *("dist", "dist_coeffs", "distCoeffs", "distortion_coefficients", "distortion_coeffs", "distortion_params", "D"),
    *("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "radial", "tangential"),
)
# Pixels by which columns may lean from the top of an image to its bottom; calibrations that estimate it find less.
_SKEW_NAMES = ("skew", "s", "alpha_c")
_MAX_SKEW = 1.0
# No calibration board covers the very corners: those of a real KITTI camera fold, 0.07 % of its image.
_MAX_LOST_FRACTION = 1e-3
# Undistorted over distorted radius at the image's edge. Wide-angle lenses reach 2, strong pincushions 0.8.
_STRETCH_RANGE = (0.5, 4.0)
# Tangential terms come from a sensor that is not quite parallel to its lens: calibrations have below 0.005.
_MAX_TANGENTIAL = 0.03
_DIRECTIONS = 128
_RADII = 1024
_BISECTIONS = 30
_GRID_SIZE = 65


@dataclass(frozen=True)
class DistortionReach:
    """How far from the principal point a distorted lens forms an image.

    Attributes:
        corner_radius_px: distance of the farthest corner of the image from the principal point.
        fold_radius_px: distance in the image at which it first folds back; ``inf`` where the image ends before.
        lost_fraction: fraction of the image that no ray of the lens reaches.
        stretch: undistorted over distorted radius at the corner's distance, of the direction where it is farthest
            from 1; ``inf`` where no ray comes that far out.
    """

    corner_radius_px: float
    fold_radius_px: float
    lost_fraction: float
    stretch: float


def read_distortion(intrinsics: Mapping[str, Any], **where: Any) -> tuple[float, ...]:
    """Reads the key ``distortion`` of a file's intrinsics, and refuses what it cannot mean for sure.

    Args:
        intrinsics: of one camera, as a JSON file has them.
        where: file, log and camera for the error, as ``GenreError`` takes them.

    Returns:
        None, 1, 2, 4 or 5 coefficients: k1, k2, p1, p2, k3.

    Raises:
        InputError: another lens model, skew, coefficients under another name, text, or a count whose meaning is not
            certain.

    >>> read_distortion({"distortion": [-0.2, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]})
    (-0.2, 0.1, 0.0, 0.0, 0.0)
    """
    _refuse_other_model(intrinsics, where)
    refuse_unread_distortion(intrinsics, (_DISTORTION_KEY,), f"Write them as {_DISTORTION_KEY}: [{_MODEL}].", **where)
    _refuse_skew(intrinsics, where)
    values = intrinsics.get("distortion")
    if values is None:
        return ()
    # The digits of a text would pass for numbers.
    if isinstance(values, str):
        problem = f"distortion is the text {values!r}; a list of numbers was expected"
        raise InputError(problem, remedy=f"Write [{_MODEL}].", **where)
    try:
        coefficients = tuple(float(value) for value in values)
    except (TypeError, ValueError) as error:
        problem = f"distortion is no list of numbers ({error})"
        raise InputError(problem, remedy=f"Write {_MODEL}.", **where) from error
    # Three are k1, k2, p1 to OpenCV and k1, k2, k3 to Argoverse.
    if len(coefficients) == 3 and coefficients[2]:
        problem = "distortion has 3 coefficients, whose last may be p1 or k3"
        raise InputError(problem, remedy=f"Write all five: {_MODEL}.", **where)
    # Zeros behind the model's own say nothing: OpenCV writes 8, 12 or 14 of them.
    return coefficients if any(coefficients[_COUNT:]) else coefficients[:_COUNT]


def refuse_unread_distortion(intrinsics: Mapping[str, Any], read: Collection[str], remedy: str, **where: Any) -> None:
    """Refuses distortion coefficients that stand under a name which a reader does not read.

    Args:
        intrinsics: of one camera, as a JSON file has them.
        read: names that the reader reads.
        remedy: where the coefficients belong.
        where: file, log and camera for the error, as ``GenreError`` takes them.

    Raises:
        InputError: another name has a value that is not zero.
    """
    names = [name for name in _DISTORTION_NAMES if name not in read and _has_value(intrinsics.get(name))]
    if names:
        problem = f"distortion coefficients stand under {', '.join(names)}, which is not read"
        raise InputError(problem, remedy=remedy, **where)


def with_distortion(lens: Lens, intrinsics: Mapping[str, Any], **where: Any) -> Lens:
    """Adds the distortion that a file states to a lens, and refuses what no image can be reconstructed with.

    Args:
        lens: of the camera, without distortion.
        intrinsics: of the camera, as a JSON file has them.
        where: file, log and camera for the error, as ``GenreError`` takes them.

    Returns:
        The lens with its distortion.

    Raises:
        InputError: as ``read_distortion`` raises, and for too many coefficients, coefficients that are not finite, and
            a distortion that folds back inside the image or is out of all proportion.
    """
    distorted = replace(lens, distortion=read_distortion(intrinsics, **where))
    for finding in find_distortion_faults(distorted):
        if finding.severity == "fatal":
            raise InputError(finding.message, remedy=finding.remedy, **where)
    return distorted


@lru_cache(maxsize=256)
def find_distortion_faults(lens: Lens, camera: str | None = None) -> tuple[Finding, ...]:
    """Finds what is wrong with the distortion of a lens.

    Args:
        lens: of a camera, its intrinsics finite and its focal lengths positive.
        camera: its name for the findings; ``None`` where it is not known.

    Returns:
        ``unsupported_distortion``, ``invalid_distortion``, ``folding_distortion``, ``extreme_distortion`` or
        ``odd_tangential_distortion``; nothing for a sound lens.

    >>> find_distortion_faults(Lens(1000.0, 1000.0, 960.0, 540.0, 1920, 1080, (-0.9,)))[0].word
    'folding_distortion'
    """
    if not any(lens.distortion):
        return ()
    if not np.isfinite(lens.distortion).all():
        message = "a distortion coefficient is not finite"
        return (Finding("invalid_distortion", "fatal", message, f"Write {_MODEL}.", camera=camera),)
    if any(lens.distortion[_COUNT:]):
        count = len(lens.distortion)
        message = f"the distortion has {count} coefficients; the lens model has {_COUNT} ({_MODEL})"
        numbers = {"coefficients": float(count), "limit": float(_COUNT)}
        return (Finding("unsupported_distortion", "fatal", message, _REMEDY, numbers, camera),)
    return tuple(_judge_reach(lens, camera))


def _judge_reach(lens: Lens, camera: str | None) -> list[Finding]:
    # Absurd coefficients overflow far out, to infinities that compare as they should.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        reach = measure_distortion_reach(lens)
    if reach.lost_fraction > 0:
        numbers = {
            "fold_radius_px": reach.fold_radius_px,
            "corner_radius_px": reach.corner_radius_px,
            "lost_percent": 100 * reach.lost_fraction,
        }
        message = (
            f"the distortion folds back {reach.fold_radius_px:.0f} px from the principal point; "
            f"the image reaches to {reach.corner_radius_px:.0f} px ({100 * reach.lost_fraction:.2g} % is lost)"
        )
        severity: Severity = "fatal" if reach.lost_fraction > _MAX_LOST_FRACTION else "note"
        remedy = f"Check order and sign of the coefficients ({_MODEL}), or undistort the images."
        return [Finding("folding_distortion", severity, message, remedy, numbers, camera)]
    lowest, highest = _STRETCH_RANGE
    if not lowest <= reach.stretch <= highest:
        numbers = {"stretch": reach.stretch, "lowest": lowest, "highest": highest}
        message = (
            f"the distortion moves the image's corner, {reach.corner_radius_px:.0f} px from the principal point, "
            f"by the factor {reach.stretch:.3g}; real lenses stay within {lowest:g} to {highest:g}"
        )
        remedy = f"Check the coefficients ({_MODEL}, for normalised coordinates), or undistort the images."
        return [Finding("extreme_distortion", "fatal", message, remedy, numbers, camera)]
    largest = max(abs(p) for p in lens.coefficients[2:4])
    if largest > _MAX_TANGENTIAL:
        numbers = {"tangential": largest, "limit": _MAX_TANGENTIAL}
        message = f"a tangential coefficient is {largest:.3g}; calibrations stay below {_MAX_TANGENTIAL:g}"
        remedy = f"Check the order of the coefficients: {_MODEL}."
        return [Finding("odd_tangential_distortion", "warning", message, remedy, numbers, camera)]
    return []


def measure_distortion_reach(lens: Lens) -> DistortionReach:
    """Measures where a distorted lens stops to form an image, tangential terms included.

    Rays are followed outwards in all directions until the Jacobian of the distortion loses its positive definiteness,
    from where on the image would turn back over itself.

    Args:
        lens: with finite coefficients.

    Returns:
        Distances, and the lost fraction of the image.
    """
    focal_px = float(np.hypot(lens.fx_px, lens.fy_px) / np.sqrt(2))
    u, v = np.meshgrid(np.linspace(0, lens.width_px, _GRID_SIZE), np.linspace(0, lens.height_px, _GRID_SIZE))
    grid_x = (u - lens.cx_px) / lens.fx_px
    grid_y = (v - lens.cy_px) / lens.fy_px
    grid_radius = np.hypot(grid_x, grid_y)
    corner = float(grid_radius.max())
    angles = np.linspace(-np.pi, np.pi, _DIRECTIONS, endpoint=False)
    radii = np.linspace(0.0, _STRETCH_RANGE[1] * corner, _RADII)
    x = np.cos(angles)[:, None] * radii
    y = np.sin(angles)[:, None] * radii
    folded = _smallest_slope(x, y, lens.coefficients) <= 0
    reached = np.hypot(*distort(x, y, lens.coefficients)) >= corner
    # Argmax gives the first; a column at the end stands for "never".
    never = np.ones((_DIRECTIONS, 1), dtype=bool)
    first_fold = np.concatenate([folded, never], axis=1).argmax(axis=1)
    first_reach = np.concatenate([reached, never], axis=1).argmax(axis=1)
    folds = first_fold < np.minimum(first_reach, _RADII)
    fold_radii = _refine_fold(angles, radii, np.where(folds, first_fold, 1), lens.coefficients)
    fold_x, fold_y = distort(np.cos(angles) * fold_radii, np.sin(angles) * fold_radii, lens.coefficients)
    # Directions without a fold reach far beyond the image.
    limits = np.where(folds, np.hypot(fold_x, fold_y), 10 * corner)
    bent_angles = np.where(folds, np.arctan2(fold_y, fold_x), angles)
    pixel_limits = np.interp(np.arctan2(grid_y, grid_x), *_sort_by(bent_angles, limits), period=2 * np.pi)
    lost = grid_radius > pixel_limits
    stretches = np.where(first_reach < _RADII, radii[np.minimum(first_reach, _RADII - 1)] / corner, np.inf)
    return DistortionReach(
        corner_radius_px=corner * focal_px,
        fold_radius_px=float(pixel_limits[lost].min()) * focal_px if lost.any() else np.inf,
        lost_fraction=float(lost.mean()),
        stretch=float(stretches[np.abs(np.log(np.maximum(stretches, 1e-9))).argmax()]),
    )


def _smallest_slope(x: Float64, y: Float64, coefficients: tuple[float, ...]) -> Float64:
    """The smaller eigenvalue of the distortion's symmetric Jacobian."""
    xx, xy, yy = distortion_jacobian(x, y, coefficients)
    smallest: Float64 = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    return smallest


def _refine_fold(
    angles: Float64,  # [A]
    radii: Float64,  # [R]
    first_fold: NDArray[np.int64],  # [A] index of a radius beyond the fold
    coefficients: tuple[float, ...],
) -> Float64:
    """[A] undistorted radius of the fold in every direction, by bisection."""
    low = radii[np.maximum(first_fold - 1, 0)]
    high = radii[np.minimum(first_fold, len(radii) - 1)]
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        folded = _smallest_slope(np.cos(angles) * middle, np.sin(angles) * middle, coefficients) <= 0
        low = np.where(folded, low, middle)
        high = np.where(folded, middle, high)
    return low


def _sort_by(keys: Float64, values: Float64) -> tuple[Float64, Float64]:
    order = np.argsort(keys)
    return keys[order], values[order]


def _refuse_other_model(intrinsics: Mapping[str, Any], where: Mapping[str, Any]) -> None:
    """Raises for a lens model that is not Brown–Conrady, however small its coefficients are."""
    for key in _MODEL_KEYS:
        name = intrinsics.get(key)
        if not isinstance(name, str):
            continue
        plain = name.strip().lower().replace("-", "_").replace(" ", "_")
        # ``model`` may be the product's name, of which nothing is known.
        is_other = any(other in plain for other in _OTHER_MODELS) or (key != "model" and plain not in _KNOWN_MODELS)
        # Brown–Conrady is the rational model whose denominator is 1; more coefficients are refused by their count.
        if is_other and "rational" not in plain:
            raise InputError(f"the lens model is {name!r}; {_MODEL} were expected", remedy=_REMEDY, **where)


def _refuse_skew(intrinsics: Mapping[str, Any], where: Mapping[str, Any]) -> None:
    """Raises for pixels whose axes are not at right angles, which the lens model does not have."""
    for name in _SKEW_NAMES:
        skew = intrinsics.get(name)
        if isinstance(skew, int | float) and not abs(skew) <= _MAX_SKEW:
            problem = f"the intrinsics have a skew ({name} = {skew:g}), which is not read"
            remedy = "Write 0 if it stands for something else, or rectify the images without skew."
            raise InputError(problem, remedy=remedy, **where)


def _has_value(value: Any) -> bool:
    """Whether a value, a number or a list of them, is anything but zero."""
    if isinstance(value, list | tuple):
        return any(_has_value(entry) for entry in value)
    return value not in (None, 0, "")
