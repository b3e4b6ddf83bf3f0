"""Opens encoded images and reads from their headers what decides how the pixels are decoded."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from dataclasses import dataclass
from typing import Any

from PIL import ExifTags, Image, ImageFile, UnidentifiedImageError

from genre_tasks.errors import InputError
from genre_tasks.logs.file_kinds import describe_non_image

# Truncated files must raise; another package may have set this flag of the process.
ImageFile.LOAD_TRUNCATED_IMAGES = False
# Larger images are refused below, with a remedy.
warnings.simplefilter("ignore", Image.DecompressionBombWarning)

# Formats of camera images. Others, such as PostScript, start programs or have no signature to tell them from noise.
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "DIB", "PPM", "JPEG2000", "GIF", "AVIF")
_FORMAT_REMEDY = "Export it as 8-bit JPEG or PNG."
_DAMAGED_REMEDY = "Fetch the file again, or remove it."

# What PIL raises, with a message, for files that are truncated, corrupt or absurdly large.
_SPOKEN_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    RuntimeError,
    zlib.error,
    struct.error,
    Image.DecompressionBombError,
)
# What its plugins let through where tags or tables are damaged.
_SILENT_ERRORS = (EOFError, TypeError, LookupError, ArithmeticError)

# More than any camera has; decoded, it takes 300 MB.
_MAX_PIXELS = 100_000_000
_UPRIGHT = 1
_ORIENTATIONS = range(1, 9)

# Rec. ITU-T H.273: the primaries of sRGB, and transfer functions that 8-bit pictures are viewed with as if sRGB.
_SRGB_PRIMARIES = 1
_UNSPECIFIED = 2
_DISPLAY_TRANSFERS = (1, 2, 6, 13, 14, 15)

# Chunks of a PNG that Pillow does not report, or only after the pixels.
_PNG_CHUNKS = (b"sBIT", b"cICP", b"eXIf")
# The box of an AVIF with its colour space lies in the header, well before the pixels.
_AVIF_HEADER_BYTES = 4096
_TIFF_BITS = 258
_TIFF_PHOTOMETRIC = 262
_TIFF_SAMPLE_FORMAT = 339
_TIFF_WHITE_IS_ZERO = 0
# Unsigned, or not stated.
_TIFF_UNSIGNED = {1, 4}
_JPEG_END = b"\xff\xd9"
_JPEG_SCAN = b"\xff\xda"
# Encoders make about ten; thumbnails and further pictures of the file have a few more.
_MAX_SCANS = 100
# A download that was cut off leaves zeros where the file was reserved at its final size.
_ZERO_TAIL_BYTES = 16


@dataclass(frozen=True)
class ImageHeader:
    """What the header of an image says beside its mode.

    Attributes:
        width_px: of the stored picture.
        height_px: of the stored picture.
        bits: a sample as stored, 1 to 16.
        significant_bits: bits of a sample that the sensor has, where a PNG states them; else ``None``.
        is_inverted: zero is white.
        pictures: how many pictures, pages or moments of an animation the file holds.
        has_main_picture: the format says that the first picture is the one that was taken.
    """

    width_px: int
    height_px: int
    bits: int
    significant_bits: int | None
    is_inverted: bool
    pictures: int
    has_main_picture: bool


def describe_decode_error(error: Exception) -> InputError:
    """Makes an error of the family from what Pillow raised.

    Args:
        error: from opening, loading or converting an image.

    Returns:
        The error, to be raised; one of the family is returned as it is.
    """
    if isinstance(error, InputError):
        return error
    reason = str(error) if isinstance(error, _SPOKEN_ERRORS) else "its header is damaged"
    # Pillow has many words for this one, some with a count of bytes.
    if "truncated" in reason.lower():
        reason = "the file is truncated"
    return InputError(f"cannot decode the image: {reason}", remedy=_DAMAGED_REMEDY)


DECODE_ERRORS: tuple[type[Exception], ...] = (InputError, *_SPOKEN_ERRORS, *_SILENT_ERRORS)
"""All that opening or loading a damaged image raises."""


def open_image(data: bytes) -> tuple[Image.Image, ImageHeader]:
    """Opens an encoded image without decoding its pixels, and refuses what no rule can decode.

    Args:
        data: the encoded file.

    Returns:
        The opened image, and what its header says.

    Raises:
        InputError: the picture is turned, of a wide or linear colour space without a profile, too large, or cut off.
        Exception: one of ``DECODE_ERRORS``, for :func:`describe_decode_error`.
    """
    image = _open(data)
    width, height = image.size
    if width * height > _MAX_PIXELS:
        problem = f"the image has {width}×{height} pixels, more than {_MAX_PIXELS // 1_000_000} million"
        raise InputError(problem, remedy="Reduce it, with its intrinsics, or fetch it again.")
    chunks = _read_png_chunks(data) if image.format == "PNG" else {}
    _refuse_cut_off(image, data)
    _refuse_many_scans(image, data)
    _refuse_turned(image, chunks.get(b"eXIf"))
    _refuse_wide_color(_read_color_code(image, data, chunks))
    tags = dict(image.tag_v2) if image.format == "TIFF" and hasattr(image, "tag_v2") else {}
    _refuse_sample_formats(image, tags)
    bits = _count_bits(image, data, tags)
    header = ImageHeader(
        width_px=width,
        height_px=height,
        bits=bits,
        significant_bits=max(chunks[b"sBIT"], default=None) if b"sBIT" in chunks else None,
        # Pillow inverts what has up to 8 bits by itself.
        is_inverted=bits > 8 and tags.get(_TIFF_PHOTOMETRIC) == _TIFF_WHITE_IS_ZERO,
        pictures=int(getattr(image, "n_frames", 1)),
        has_main_picture=image.format == "MPO",
    )
    return image, header


def _open(data: bytes) -> Image.Image:
    try:
        return Image.open(io.BytesIO(data), formats=FORMATS)
    # Pillow's words for this hold an address in memory, which differs from run to run.
    except UnidentifiedImageError as error:
        kind, _, remedy = (describe_non_image(data) or "").partition("; ")
        reason = f"the file is {kind}" if kind else "its format is unknown, or its header is damaged"
        remedy = f"{remedy[:1].upper()}{remedy[1:]}." if remedy else _DAMAGED_REMEDY
        raise InputError(f"cannot decode the image: {reason}", remedy=remedy) from error


def _read_png_chunks(data: bytes) -> dict[bytes, bytes]:
    """Name → content of the chunks that are read here, wherever they stand."""
    chunks: dict[bytes, bytes] = {}
    position = 8
    while position + 8 <= len(data):
        length, name = struct.unpack_from(">I4s", data, position)
        if name in _PNG_CHUNKS:
            chunks.setdefault(name, data[position + 8 : position + 8 + length])
        position += length + 12
    return chunks


def _refuse_cut_off(image: Image.Image, data: bytes) -> None:
    """Raises where the end of a JPEG is zeros, of which Pillow would make grey."""
    if image.format not in ("JPEG", "MPO") or not data.endswith(bytes(_ZERO_TAIL_BYTES)):
        return
    if not data.rstrip(b"\0").endswith(_JPEG_END):
        raise InputError("cannot decode the image: its end is zeros", remedy=_DAMAGED_REMEDY)


def _refuse_many_scans(image: Image.Image, data: bytes) -> None:
    """Raises where a JPEG repeats scans, of which every one goes over all pixels: minutes for a small file."""
    # Within compressed data these two bytes cannot follow each other.
    if image.format in ("JPEG", "MPO") and data.count(_JPEG_SCAN) > _MAX_SCANS:
        raise InputError("cannot decode the image: it has too many scans", remedy=_FORMAT_REMEDY)


def _refuse_turned(image: Image.Image, trailing_exif: bytes | None) -> None:
    """Raises where the file asks viewers to turn or mirror the picture."""
    if trailing_exif is not None:
        image.info.setdefault("exif", b"Exif\0\0" + trailing_exif)
    try:
        # The method of the base class: that of PNG would decode the pixels first.
        orientation = Image.Image.getexif(image).get(ExifTags.Base.Orientation, _UPRIGHT)
    except DECODE_ERRORS:
        # Metadata that cannot be read ask for nothing.
        return
    if orientation in _ORIENTATIONS and orientation != _UPRIGHT:
        raise InputError(
            f"the EXIF orientation is {orientation}: the stored pixels are to be turned, "
            "and it is unknown which of both the intrinsics describe",
            remedy="Turn the pixels as the intrinsics have them, and remove the tag (exiftool -Orientation=).",
        )


def _read_color_code(image: Image.Image, data: bytes, chunks: dict[bytes, bytes]) -> tuple[int, int] | None:
    """Code points (primaries, transfer function) of Rec. ITU-T H.273, where a PNG or an AVIF states them."""
    if len(chunks.get(b"cICP", b"")) == 4:
        return chunks[b"cICP"][0], chunks[b"cICP"][1]
    if image.format == "AVIF":
        position = data.find(b"colrnclx", 0, _AVIF_HEADER_BYTES)
        if position >= 0 and len(data) >= position + 12:
            primaries, transfer = struct.unpack_from(">HH", data, position + 8)
            return int(primaries), int(transfer)
    return None


def _refuse_wide_color(code: tuple[int, int] | None) -> None:
    if code is None:
        return
    primaries, transfer = code
    if primaries not in (_SRGB_PRIMARIES, _UNSPECIFIED) or transfer not in _DISPLAY_TRANSFERS:
        problem = f"the colours are not sRGB but of the code points {primaries} and {transfer} (HDR or wide gamut)"
        raise InputError(problem, remedy=f"Convert it to sRGB. {_FORMAT_REMEDY}")


def _refuse_sample_formats(image: Image.Image, tags: dict[int, Any]) -> None:
    """Raises where samples are not unsigned integers of at most 16 bits."""
    # Pillow scales a PGM of any maximum to 16 bits, and calls it "I" all the same.
    if image.mode == "F" or (image.mode == "I" and image.format != "PPM"):
        kind = "floating-point numbers" if image.mode == "F" else "integers of 32 bits or with a sign"
        problem = f"the samples are {kind}, of which no range is known"
        raise InputError(problem, remedy=f"Tone-map it. {_FORMAT_REMEDY}")
    if set(tags.get(_TIFF_SAMPLE_FORMAT, ())) - _TIFF_UNSIGNED:
        raise InputError("the samples are not unsigned integers", remedy=_FORMAT_REMEDY)


def _count_bits(image: Image.Image, data: bytes, tags: dict[int, Any]) -> int:
    """Bits of a stored sample."""
    if image.format == "PNG":
        # The header chunk is the first one; its ninth byte is the depth.
        return data[24]
    if tags.get(_TIFF_BITS):
        return max(tags[_TIFF_BITS])
    return 16 if image.mode.startswith("I") else 8
