"""Whether the intrinsics of a camera belong to its images."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.lens_validity import find_distortion_faults
from genre_tasks.logs.types import Camera, Lens

# Principal points as multiples of the image's middle. The widest of real rigs: PandaSet 0.86 to 1.03, KITTI 0.92,
# Argoverse 0.99, nuScenes 1.09. Images of Waymo's sides are cropped at the top: 0.5 of their height.
_HORIZONTAL_RANGE = (0.7, 1.4)
_VERTICAL_RANGE = (0.35, 1.6)
# Both axes off by one factor are a resized image, at less than either axis alone could show.
_RESIZED_RANGE = (0.83, 1.2)
_MAX_FACTOR_RATIO = 1.25
# Long-range cameras see 15°; beyond 150° a pinhole stretches its edges without limit, and lenses are fisheyes.
_FIELD_OF_VIEW_RANGE_DEG = (8.0, 150.0)
# A focal length of fewer pixels is no number of pixels.
_MIN_FOCAL_PX = 10.0
# In units of the image's width, a middle has coordinates below 1; half a pixel may have been added.
_MAX_NORMALISED = 1.6
# Calibrations of square pixels give 0.995 to 1.005; images for networks are resized to sides that differ by 10 %.
_ASPECT_RANGE = (0.85, 1.18)
# Factors by which people resize images.
_COMMON_FACTORS = (1 / 8, 1 / 4, 1 / 3, 3 / 8, 1 / 2, 2 / 3, 3 / 4, 1.5, 2.0, 3.0, 4.0, 8.0)
_FACTOR_TOLERANCE = 0.08
# Slow sensors read for 50 ms, and cameras at night expose for as long; milliseconds would be numbers from 1.
_MAX_SHUTTER_S = 0.15
_SIZE_REMEDY = "Export the images at the size of the intrinsics, or scale the intrinsics to the images."


def find_implausible_lenses(sample: LogSample) -> Iterator[Finding]:
    """Finds intrinsics that are of other images, in another unit, or distorted beyond sense.

    Args:
        sample: the frames of a chunk.

    Yields:
        For each camera ``odd_focal_length``, ``odd_principal_point`` or ``odd_pixel_aspect``, ``odd_shutter_time``, and
        what ``find_distortion_faults`` finds.
    """
    for camera in sample.cameras:
        lens = camera.lens
        if not _is_measurable(lens):
            message = f"{camera.name}: the intrinsics are not finite, or a focal length or size is not positive"
            yield Finding("odd_focal_length", "fatal", message, "Correct the intrinsics.", camera=camera.name)
            continue
        focal = _judge_focal_length(camera)
        # A wrong unit makes every other number of the lens odd as well.
        yield from (focal,) if focal else (*_judge_principal_point(camera), *_judge_aspect(camera))
        yield from find_distortion_faults(lens, camera.name)
        yield from _judge_shutter(camera)


def _is_measurable(lens: Lens) -> bool:
    values = (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
    return bool(np.isfinite(values).all()) and min(lens.fx_px, lens.fy_px, lens.width_px, lens.height_px) > 0


def _judge_focal_length(camera: Camera) -> Finding | None:
    lens = camera.lens
    narrowest, widest = _FIELD_OF_VIEW_RANGE_DEG
    fields_deg = [
        2 * float(np.degrees(np.arctan(size / (2 * focal))))
        for size, focal in ((lens.width_px, lens.fx_px), (lens.height_px, lens.fy_px))
    ]
    numbers = {
        "focal_px": lens.fx_px,
        "field_of_view_deg": fields_deg[0],
        "narrowest_deg": narrowest,
        "widest_deg": widest,
    }
    message = (
        f"{camera.name}: the focal length of {lens.fx_px:.4g} px sees {fields_deg[0]:.0f}° "
        f"of an image of {lens.width_px}×{lens.height_px}; {narrowest:g}° to {widest:g}° is plausible"
    )
    if lens.fx_px < _MIN_FOCAL_PX:
        in_widths = max(abs(lens.cx_px), abs(lens.cy_px)) <= _MAX_NORMALISED
        unit = "fractions of the image's size" if in_widths else "millimetres"
        remedy = f"The intrinsics look like {unit}: convert them to pixels."
        return Finding("odd_focal_length", "warning", message, remedy, numbers, camera.name)
    # A tall image is narrow across: the longer side says how wide a lens is, the shorter one how narrow.
    if max(fields_deg) > widest or max(fields_deg) < narrowest:
        remedy = f"Check the unit of the intrinsics (pixels), and whose images they are. {_SIZE_REMEDY}"
        return Finding("odd_focal_length", "warning", message, remedy, numbers, camera.name)
    return None


def _judge_principal_point(camera: Camera) -> Iterator[Finding]:
    lens = camera.lens
    # 1 is the middle of the image.
    horizontal = 2 * lens.cx_px / lens.width_px
    vertical = 2 * lens.cy_px / lens.height_px
    are_alike = min(horizontal, vertical) > 0 and (
        max(horizontal, vertical) <= _MAX_FACTOR_RATIO * min(horizontal, vertical)
    )
    resized = are_alike and (
        min(horizontal, vertical) > _RESIZED_RANGE[1] or max(horizontal, vertical) < _RESIZED_RANGE[0]
    )
    off_centre = not (
        _HORIZONTAL_RANGE[0] <= horizontal <= _HORIZONTAL_RANGE[1]
        and _VERTICAL_RANGE[0] <= vertical <= _VERTICAL_RANGE[1]
    )
    if not (resized or off_centre):
        return
    message = (
        f"{camera.name}: the principal point ({lens.cx_px:.0f}, {lens.cy_px:.0f}) lies at {horizontal:.2f}× and "
        f"{vertical:.2f}× the middle of the {lens.width_px}×{lens.height_px} image"
    )
    numbers = {
        "horizontal": horizontal,
        "lowest_horizontal": _HORIZONTAL_RANGE[0],
        "highest_horizontal": _HORIZONTAL_RANGE[1],
        "vertical": vertical,
        "lowest_vertical": _VERTICAL_RANGE[0],
        "highest_vertical": _VERTICAL_RANGE[1],
    }
    if resized:
        factor = _round_factor(2 / (horizontal + vertical))
        numbers["factor"] = factor
        remedy = f"The images look resized by {factor:.2g}: export them at the size of the intrinsics, or scale these."
    else:
        remedy = f"The images look cropped or stretched, or the intrinsics are of another camera. {_SIZE_REMEDY}"
    yield Finding("odd_principal_point", "warning", message, remedy, numbers, camera.name)


def _round_factor(factor: float) -> float:
    """The common factor that is next, where one is near."""
    nearest = min(_COMMON_FACTORS, key=lambda common: abs(np.log(factor / common)))
    return nearest if abs(np.log(factor / nearest)) < _FACTOR_TOLERANCE else factor


def _judge_aspect(camera: Camera) -> Iterator[Finding]:
    aspect = camera.lens.fx_px / camera.lens.fy_px
    lowest, highest = _ASPECT_RANGE
    if lowest <= aspect <= highest:
        return
    message = f"{camera.name}: fx is {aspect:.3g} of fy; square pixels have {lowest:g} to {highest:g}"
    remedy = "Check fx and fy; they are right only where the images were stretched by as much."
    numbers = {"aspect": aspect, "lowest": lowest, "highest": highest}
    yield Finding("odd_pixel_aspect", "warning", message, remedy, numbers, camera.name)


def _judge_shutter(camera: Camera) -> Iterator[Finding]:
    for name, seconds in (("readout_s", camera.readout_s), ("exposure_s", camera.exposure_s)):
        if 0 <= seconds <= _MAX_SHUTTER_S:
            continue
        message = f"{camera.name}: {name} is {seconds:.4g} s; 0 to {_MAX_SHUTTER_S:g} s is plausible"
        numbers = {name: seconds, "limit_s": _MAX_SHUTTER_S}
        yield Finding("odd_shutter_time", "warning", message, "Write seconds: 30 ms are 0.03.", numbers, camera.name)
