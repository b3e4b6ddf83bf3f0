"""Colour spaces of images: what a file states, and the conversion to sRGB."""

from __future__ import annotations

import io
from functools import lru_cache

import numpy as np
from PIL import Image, ImageCms

from genre_tasks.logs.findings import Finding
from genre_tasks.srgb import linear_to_srgb

# Profiles of sRGB differ in their last digits; a deviation of so many of 255 levels is none.
_SAME_LEVELS = 2
_LATTICE_STEPS = 9
# The exponent of 1/2.2 that files of sRGB state, and how far others may round it.
_SRGB_EXPONENT = 1 / 2.2
_EXPONENT_TOLERANCE = 0.05
# Chromaticities of white, red, green and blue (x, y each), and how far files may round them.
_SRGB_CHROMATICITIES = (0.3127, 0.3290, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
_CHROMATICITY_TOLERANCE = 0.01

# Colour spaces of profiles → the mode that their transform reads.
_PROFILE_MODES = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}


def read_gamma(image: Image.Image) -> float | None:
    """Reads the exponent of a PNG's samples, where it is not that of sRGB.

    Args:
        image: as opened.

    Returns:
        γ of sample = light^γ; ``None`` where the samples are sRGB, or a profile or an ``sRGB`` chunk takes precedence.
    """
    gamma = image.info.get("gamma")
    if image.format != "PNG" or not gamma or "srgb" in image.info or image.info.get("icc_profile"):
        return None
    return None if abs(gamma / _SRGB_EXPONENT - 1) <= _EXPONENT_TOLERANCE else float(gamma)


def gamma_table(gamma: float | None, maximum: int, values: int) -> np.ndarray:
    """Makes the table from samples to 8-bit sRGB.

    Args:
        gamma: of the samples, from :func:`read_gamma`; ``None`` for those of sRGB.
        maximum: the sample that is white; larger ones are white too.
        values: entries of the table.

    Returns:
        [values] uint8, rounded.

    >>> gamma_table(None, 65535, 65536)[[0, 128, 129, 65535]].tolist()
    [0, 0, 1, 255]
    """
    share = np.minimum(np.arange(values, dtype=np.float64) / maximum, 1.0)
    display = share if gamma is None else linear_to_srgb(share ** (1 / gamma))
    return np.floor(display * 255 + 0.5).astype(np.uint8)


def find_other_primaries(image: Image.Image) -> Finding | None:
    """Finds primaries that a PNG states without a profile to convert them by.

    Args:
        image: as opened.

    Returns:
        ``unconverted_colors``, or ``None``.
    """
    stated = image.info.get("chromaticity")
    if image.format != "PNG" or not stated or "srgb" in image.info or image.info.get("icc_profile"):
        return None
    deviation = float(np.abs(np.subtract(stated, _SRGB_CHROMATICITIES)).max())
    if deviation <= _CHROMATICITY_TOLERANCE:
        return None
    return _unconverted("the file states other primaries than sRGB without a profile", {"deviation": deviation})


def convert_profile(image: Image.Image, profile: bytes) -> tuple[Image.Image, Finding | None]:
    """Converts colours by the file's ICC profile; those of an sRGB profile stay the same bytes.

    Args:
        image: 8 bits, without alpha.
        profile: the file's.

    Returns:
        The image as RGB, and what was or could not be done.
    """
    try:
        mode, transform = _build_transform(profile)
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError) as error:
        return image.convert("RGB"), _unconverted(f"the colour profile cannot be read ({error})", {})
    # A grey image of a colour profile is common: its grey is the profile's. The reverse has no meaning.
    fits = mode == image.mode or (mode == "RGB" and image.mode != "CMYK")
    if not fits:
        problem = f"the colour profile is for {mode}, the image is {image.mode}"
        return image.convert("RGB"), _unconverted(problem, {})
    if transform is None:
        return image.convert("RGB"), None
    converted = ImageCms.applyTransform(image.convert(mode), transform)
    if converted is None:
        return image.convert("RGB"), _unconverted("the colour profile cannot be applied", {})
    return converted, report_conversion("by the file's colour profile")


def convert_lab(image: Image.Image) -> Image.Image:
    """Converts CIE L*a*b* of white point D50 to sRGB.

    Args:
        image: of mode ``LAB``.

    Returns:
        The image as RGB.
    """
    lab = ImageCms.createProfile("LAB")
    srgb = ImageCms.createProfile("sRGB")
    transform = ImageCms.buildTransform(lab, srgb, "LAB", "RGB", ImageCms.Intent.RELATIVE_COLORIMETRIC)
    converted = ImageCms.applyTransform(image, transform)
    if converted is None:
        raise ValueError("no conversion from LAB")
    return converted


def report_conversion(how: str) -> Finding:
    """Makes the note that colours were converted to sRGB.

    Args:
        how: a clause.

    Returns:
        ``converted_colors``.
    """
    return Finding("converted_colors", "note", f"the colours are converted to sRGB {how}")


def _unconverted(problem: str, numbers: dict[str, float]) -> Finding:
    message = f"{problem}; the colours are taken as sRGB"
    return Finding("unconverted_colors", "warning", message, "Convert the images to sRGB.", numbers)


# Every image of a camera has the same profile.
@lru_cache(maxsize=16)
def _build_transform(profile: bytes) -> tuple[str, ImageCms.ImageCmsTransform | None]:
    """The mode that a profile is for, and its transform to sRGB: ``None`` where it is sRGB itself."""
    source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    space = str(source.profile.xcolor_space).strip()
    mode = _PROFILE_MODES.get(space)
    if mode is None:
        raise ValueError(f"it is for {space}")
    transform = ImageCms.buildTransform(
        source,
        ImageCms.createProfile("sRGB"),
        mode,
        "RGB",
        ImageCms.Intent.RELATIVE_COLORIMETRIC,
        ImageCms.Flags.BLACKPOINTCOMPENSATION,
    )
    if mode == "CMYK":
        return mode, transform
    # By what it does and not by its name: there are dozens of sRGB profiles, and names that lie.
    probe = _make_probe(mode)
    converted = ImageCms.applyTransform(probe, transform)
    difference = np.asarray(converted).astype(int) - np.asarray(probe.convert("RGB"))
    return mode, None if np.abs(difference).max() <= _SAME_LEVELS else transform


def _make_probe(mode: str) -> Image.Image:
    """An image of all greys, or of colours on a lattice."""
    if mode == "L":
        return Image.fromarray(np.arange(256, dtype=np.uint8)[None])
    levels = np.linspace(0, 255, _LATTICE_STEPS).round().astype(np.uint8)
    return Image.fromarray(np.stack(np.meshgrid(levels, levels, levels), -1).reshape(1, -1, 3))
