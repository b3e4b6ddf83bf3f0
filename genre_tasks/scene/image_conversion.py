"""Pixels of any mode to 8-bit sRGB by the rules of ``image_decoding``, with findings of what that loses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from genre_tasks.logs.findings import Finding, Severity
from genre_tasks.scene.image_color import (
    convert_lab,
    convert_profile,
    find_other_primaries,
    gamma_table,
    read_gamma,
    report_conversion,
)
from genre_tasks.scene.image_header import ImageHeader

_FULL_16_BIT = 65535
# Largest value of 14 bits: cameras of 10, 12 and 14 bits often write their samples into 16 bits as they are.
_NARROW_MAXIMUM = 16383
# With alpha between black and colours, or colours of another space.
_PREMULTIPLIED = {"La": "LA", "RGBa": "RGBA"}
_WITH_ALPHA = ("LA", "RGBA", "PA")
_OTHER_SPACES = ("CMYK", "YCbCr", "HSV", "LAB")


def convert_to_srgb(image: Image.Image, header: ImageHeader) -> tuple[Image.Image, tuple[Finding, ...]]:
    """Converts an opened image to 8-bit sRGB.

    Args:
        image: opened and loaded.
        header: what its header says.

    Returns:
        The image as RGB, and what is to be known of the conversion; nothing for ordinary 8-bit images.
    """
    findings: list[Finding] = []
    if header.pictures > 1:
        findings.append(_report_pictures(header))
    gamma = read_gamma(image)
    profile = image.info.get("icc_profile")
    other_primaries = find_other_primaries(image)
    if image.mode.startswith("I"):
        image = _reduce_grey(image, header, gamma, findings)
    else:
        if image.mode == "1":
            findings.append(_report_one_bit())
        image = _drop_alpha(image, findings)
        if header.bits > 8:
            # Pillow has kept the upper 8 bits of each sample.
            _report_depth(findings, header.bits, int(np.asarray(image).max(initial=0)) * 256 + 255, _FULL_16_BIT)
        if gamma is not None:
            image = image.point(gamma_table(gamma, 255, 256).tolist() * len(image.getbands()))
    if gamma is not None:
        findings.append(report_conversion(f"from the file's gamma of {gamma:.3g}"))
    if other_primaries:
        findings.append(other_primaries)
    return _convert_color(image, profile, findings), tuple(findings)


def _reduce_grey(image: Image.Image, header: ImageHeader, gamma: float | None, findings: list[Finding]) -> Image.Image:
    """Grey of up to 16 bits to 8 bits, by the depth that is stated or that of the file."""
    samples: NDArray[np.uint16] = np.asarray(image).astype(np.uint16)
    if "transparency" in image.info:
        _report_transparency(findings, float((samples == image.info["transparency"]).mean()))
    maximum = 2**header.bits - 1
    if header.is_inverted:
        samples = np.uint16(maximum) - np.minimum(samples, np.uint16(maximum))
    largest = int(samples.max(initial=0))
    if header.significant_bits and _is_right_aligned(samples, largest, header.significant_bits):
        maximum = 2**header.significant_bits - 1
    _report_depth(findings, header.bits, largest, maximum)
    return Image.fromarray(gamma_table(gamma, maximum, _FULL_16_BIT + 1)[samples])


def _is_right_aligned(samples: NDArray[np.uint16], largest: int, bits: int) -> bool:
    """Whether samples of fewer bits stand in the lower bits, where the PNG specification has them in the upper ones.

    In the upper bits, the lower ones of a dark picture are nearly zero; a sensor's are not.
    """
    if not 8 < bits < 16 or largest >= 2**bits:
        return False
    return bool(((samples & np.uint16(2 ** (16 - bits) - 1)) > 1).any())


def _drop_alpha(image: Image.Image, findings: list[Finding]) -> Image.Image:
    """8-bit pixels without palette and alpha; colours of transparent pixels stay as stored."""
    image = image.convert(_PREMULTIPLIED[image.mode]) if image.mode in _PREMULTIPLIED else image
    if image.mode in _WITH_ALPHA or "transparency" in image.info:
        image = image if image.mode in ("LA", "RGBA") else image.convert("RGBA")
        _report_transparency(findings, float((np.asarray(image.getchannel("A")) < 255).mean()))
        return image.convert("L" if image.mode == "LA" else "RGB")
    if image.mode in ("RGB", "L", *_OTHER_SPACES):
        return image
    return image.convert("RGB")


def _convert_color(image: Image.Image, profile: bytes | None, findings: list[Finding]) -> Image.Image:
    if image.mode == "LAB":
        findings.append(report_conversion("from L*a*b*"))
        return convert_lab(image)
    if profile:
        converted, finding = convert_profile(image, profile)
        if finding:
            findings.append(finding)
        return converted
    if image.mode in _OTHER_SPACES:
        findings.append(report_conversion(f"from {image.mode} without a profile"))
    return image.convert("RGB")


def _report_pictures(header: ImageHeader) -> Finding:
    message = f"the file holds {header.pictures} pictures, of which the first is taken"
    remedy = "Export one picture for each frame."
    severity: Severity = "note" if header.has_main_picture else "warning"
    return Finding("several_pictures", severity, message, remedy, {"pictures": header.pictures})


def _report_one_bit() -> Finding:
    message = "the image has one bit a pixel, black or white"
    return Finding("one_bit_image", "warning", message, "Check that it is a camera's image and not a mask.")


def _report_transparency(findings: list[Finding], share: float) -> None:
    if share:
        message = f"{share:.1%} of the pixels are transparent; their colours are taken as stored"
        remedy = "Export images without transparency, or with the recorded colours beneath it."
        findings.append(Finding("transparent_image", "warning", message, remedy, {"share": share}))


def _report_depth(findings: list[Finding], bits: int, largest: int, maximum: int) -> None:
    message = f"{bits} bits a sample are reduced to 8"
    findings.append(Finding("reduced_depth", "note", message, numbers={"bits": bits, "maximum": maximum}))
    # A black picture has no range that could be judged; others report it.
    if maximum == _FULL_16_BIT and 255 < largest <= _NARROW_MAXIMUM:
        message = f"the largest sample is {largest} of {maximum}, as if fewer bits stood in 16: the picture is dark"
        remedy = "Scale the samples to the full range of 16 bits, or state their depth in the file (PNG: sBIT)."
        numbers = {"largest": float(largest), "limit": float(_NARROW_MAXIMUM), "maximum": float(maximum)}
        findings.append(Finding("narrow_range_16_bit", "warning", message, remedy, numbers))
