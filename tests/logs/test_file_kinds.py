"""Files that are something else than expected are named, and sound ones never are."""

from __future__ import annotations

import gzip
import io
import pickle

import pytest
from PIL import Image

from genre_tasks.logs.file_kinds import describe_non_image, describe_non_json, describe_non_pickle

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:%064d\nsize 12345\n" % 1
OTHERS = {
    "Git LFS": POINTER,
    "git-annex": b"/annex/objects/MD5E-s12345--d41d8cd98f00b204e9800998ecf8427e.png\n",
    "DVC": b"outs:\n- md5: a304afb96060aad90176268345e10355\n",
    "web page": b"\xef\xbb\xbf\n<!DOCTYPE html>\n<html><title>Sign in</title></html>",
    "XML": b'<?xml version="1.0"?><Error><Code>AccessDenied</Code></Error>',
    "empty": b"",
    "zeros": bytes(500),
    "HEIC": b"\0\0\0\x18ftypheic\0\0\0\0",
    "video": b"\0\0\0\x18ftypisom\0\0\0\0",
    "NumPy": b"\x93NUMPY\x01\0",
    "Parquet": b"PAR1....",
    "OpenEXR": b"v/1\x01\x02\0\0\0",
    "macOS": b"\0\x05\x16\x07\0\x02\0\0",
    "tar": b"00.png".ljust(257, b"\0") + b"ustar\0",
}


@pytest.mark.parametrize("words", OTHERS)
def test_what_stands_in_the_place_of_a_file_is_named(words: str) -> None:
    """Report: git-lfs/git-lfs#4830 (a pointer in place of a data set)."""
    for describe in (describe_non_image, describe_non_pickle, describe_non_json):
        found = describe(OTHERS[words])
        assert found is not None and words in found


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "PPM", "JPEG2000", "AVIF"])
def test_images_are_images(kind: str) -> None:
    stream = io.BytesIO()
    Image.new("RGB", (8, 8), (1, 2, 3)).save(stream, kind)
    assert describe_non_image(stream.getvalue()) is None


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_pickles_are_pickles(protocol: int) -> None:
    data = pickle.dumps({"x": 1}, protocol=protocol)
    assert describe_non_pickle(data) is describe_non_pickle(gzip.compress(data)) is None
    assert describe_non_image(data) == "a pickle"


def test_json_is_json() -> None:
    assert describe_non_json(b' [{"position": 1}]') is None
    assert "JSON" in (describe_non_image(b'{"message": "Not Found"}') or "")


def test_what_is_not_known_is_not_named() -> None:
    assert describe_non_image(b"something else") is describe_non_json(b"1.5") is None
