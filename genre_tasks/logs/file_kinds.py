"""What a file is that was expected to be something else: pointers, web pages and other formats, by the first bytes.

People clone a repository without its large files, download a page in place of a file, or rename one format to another.
The decoder that then fails says "cannot identify the file"; here the file is named, with what to do about it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Literal

Family = Literal["image", "pickle", "json", "other"]

# A pointer or a page shows itself in its first bytes; the rest of a large file need not be searched.
_SEARCHED_BYTES = 1024
_HTML = re.compile(rb"<(!doctype html|html|head|body)\b", re.IGNORECASE)
# Paths that git-annex and DataLad write where a file's content is elsewhere.
_ANNEX = re.compile(rb"^(\.\./|/)*(\.git)?/?annex/objects/")
_DVC = re.compile(rb"^(outs|wdir|md5):", re.MULTILINE)

_UNPACK = "unpack it"
_CONVERT = "convert it to PNG or JPEG"

# Signature → family and what it is. Formats that share a beginning are told apart below.
_SIGNATURES: Mapping[bytes, tuple[Family, str]] = {
    b"\xff\xd8\xff": ("image", "a JPEG image"),
    b"\x89PNG\r\n\x1a\n": ("image", "a PNG image"),
    b"GIF8": ("image", "a GIF image"),
    b"BM": ("image", "a BMP image"),
    b"II*\0": ("image", "a TIFF image"),
    b"MM\0*": ("image", "a TIFF image"),
    b"v/1\x01": ("other", f"an OpenEXR image; {_CONVERT}"),
    b"#?RADIANCE": ("other", f"a Radiance HDR image; {_CONVERT}"),
    b"FUJIFILMCCD-RAW": ("other", f"a camera's raw image; {_CONVERT}"),
    b"\x1f\x8b": ("pickle", f"a gzip archive; {_UNPACK}"),
    b"BZh": ("pickle", f"a bzip2 archive; {_UNPACK}"),
    b"\xfd7zXZ\0": ("pickle", f"an xz archive; {_UNPACK}"),
    b"\x28\xb5\x2f\xfd": ("other", f"a Zstandard archive; {_UNPACK}"),
    b"7z\xbc\xaf\x27\x1c": ("other", f"a 7z archive; {_UNPACK}"),
    b"Rar!": ("other", f"a RAR archive; {_UNPACK}"),
    b"PK\x03\x04": ("pickle", f"a ZIP archive; {_UNPACK}"),
    b"\x93NUMPY": ("other", "a NumPy array"),
    b"PAR1": ("other", "a Parquet table"),
    b"ARROW1": ("other", "an Arrow or Feather table"),
    b"\x89HDF\r\n\x1a\n": ("other", "an HDF5 file"),
    b"ply\n": ("other", "a PLY file"),
    b"ply\r\n": ("other", "a PLY file"),
    b"# .PCD": ("other", "a PCD point cloud"),
    b"LASF": ("other", "a LAS or LAZ point cloud"),
    b"#ROSBAG": ("other", "a ROS bag"),
    b"%PDF": ("other", "a PDF document"),
    b"\x1aE\xdf\xa3": ("other", "a Matroska or WebM video; extract its frames as images"),
    b"\0\x05\x16\x07": ("other", "a macOS resource file without content; copy the file of the same name without ._"),
    b"Bud1": ("other", "a Finder file"),
    b"L\0\0\0\x01\x14\x02\0": ("other", "a Windows shortcut; copy the file that it points to"),
    b"!<symlink>": ("other", "a symbolic link of Cygwin; copy the file that it points to"),
}


def describe_non_image(data: bytes) -> str | None:
    """Names what stands where an image was expected.

    Args:
        data: the file, or at least its first 1024 bytes.

    Returns:
        What it is, with what to do about it, to follow the words "the file is"; ``None`` if it begins as an image
        does, or as nothing that is known.

    >>> describe_non_image(b"version https://git-lfs.github.com/spec/v1\\noid sha256:0\\nsize 1\\n")
    'a Git LFS pointer; run git lfs pull'
    >>> describe_non_image(b"\\x89PNG\\r\\n\\x1a\\n") is None
    True
    """
    return _describe_other_than("image", data)


def describe_non_pickle(data: bytes) -> str | None:
    """Names what stands where a pickled table was expected.

    Args:
        data: the file, or at least its first 1024 bytes.

    Returns:
        As ``describe_non_image``.

    >>> describe_non_pickle(b"<!DOCTYPE html><html>")
    'a web page, such as an error or a login; download the file again'
    """
    return _describe_other_than("pickle", data)


def describe_non_json(data: bytes) -> str | None:
    """Names what stands where a JSON file was expected.

    Args:
        data: the file, or at least its first 1024 bytes.

    Returns:
        As ``describe_non_image``.

    >>> describe_non_json(b"")
    'empty'
    """
    return _describe_other_than("json", data)


def _describe_other_than(family: Family, data: bytes) -> str | None:
    kind = _identify(data)
    return None if kind is None or kind[0] == family else kind[1]


def _identify(data: bytes) -> tuple[Family, str] | None:
    """Family and description of a file, by its beginning."""
    if not data:
        return ("other", "empty")
    start = data[:_SEARCHED_BYTES]
    for signature, kind in _SIGNATURES.items():
        if start.startswith(signature):
            return kind
    for recognise in (_identify_container, _identify_text):
        found = recognise(start)
        if found is not None:
            return found
    # A copy that broke off, or a disk that failed, leaves a file of the right size without content.
    if not data.strip(b"\0"):
        return ("other", "filled with zeros; copy it again")
    return None


def _identify_container(start: bytes) -> tuple[Family, str] | None:
    """Formats whose signature does not stand first: RIFF, ISO media, tar, pickle."""
    if start[:4] == b"RIFF":
        return ("image", "a WebP image") if start[8:12] == b"WEBP" else ("other", "an audio or video file")
    if start[4:8] == b"ftyp":
        brand = start[8:12]
        if brand in (b"avif", b"avis"):
            return ("image", "an AVIF image")
        if brand in (b"heic", b"heix", b"hevc", b"heim", b"mif1", b"msf1"):
            return ("other", f"a HEIC image; {_CONVERT}")
        return ("other", "a video; extract its frames as images")
    if start[257:262] == b"ustar":
        return ("other", f"a tar archive; {_UNPACK}")
    # Opcode PROTO, and a protocol that exists.
    if start[:1] == b"\x80" and start[1:2] in (b"\x02", b"\x03", b"\x04", b"\x05"):
        return ("pickle", "a pickle")
    return None


def _identify_text(start: bytes) -> tuple[Family, str] | None:
    """Text: pointers to a file that is elsewhere, pages, and JSON."""
    text = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    tests: tuple[tuple[Callable[[bytes], object], Family, str], ...] = (
        (lambda t: t.startswith(b"version https://git-lfs"), "other", "a Git LFS pointer; run git lfs pull"),
        (_ANNEX.match, "other", "a git-annex pointer; run git annex get, or datalad get"),
        (_DVC.match, "other", "a DVC pointer; run dvc pull"),
        (_HTML.match, "other", "a web page, such as an error or a login; download the file again"),
        (lambda t: b"<svg" in t and t.startswith(b"<"), "other", f"an SVG drawing; {_CONVERT}"),
        (lambda t: t.startswith(b"<?xml"), "other", "an XML file, such as a server's error; download the file again"),
        (lambda t: t[:1] in (b"{", b"["), "json", "a JSON file, such as a server's error; download the file again"),
    )
    for recognise, family, description in tests:
        if recognise(text):
            return (family, description)
    return None
