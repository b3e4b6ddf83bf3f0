"""A comparison as files: strips of pictures with maps of their difference, and one page with everything."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.comparison.comparison import Comparison, PicturePair
from flows.reconstruction.report.error_maps import (
    MAX_ERROR,
    ErrorMap,
    color_errors,
    compare_pixels,
    describe_scale,
)
from flows.reconstruction.report.photos import EmbeddedImage, embed_photo
from flows.reconstruction.report.writing import render_page
from genre_tasks.atomic_path import atomic_path
from storage.codecs.png import encode_png, write_png


@dataclass(frozen=True)
class _Layer:
    label: str
    image: EmbeddedImage
    words: str = ""


@dataclass(frozen=True)
class _View:
    """A pair on the page, as the template of a comparison takes it."""

    label: str
    layers: list[_Layer]


def write_strips(folder: Path, comparison: Comparison) -> list[str]:
    """Writes for each pair of pictures A, B and |A − B| side by side, as ``NAME.png``.

    Args:
        folder: where to write; it is made if it does not exist.
        comparison: with pairs of pictures.

    Returns:
        The paths of the files.

    Raises:
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for pair in comparison.pairs:
        path = folder / f"{pair.name}.png"
        with atomic_path(path) as part:
            write_png(part, _make_strip(pair))
        written.append(str(path))
    return written


def write_page(path: Path, comparison: Comparison, format_value: Callable[[Any], str] = str) -> Path:
    """Writes a comparison as one HTML file that opens from the disk without a network.

    Args:
        path: the file; its folder is made if it does not exist.
        comparison: what it shows.
        format_value: writes a value of a table for readers.

    Returns:
        ``path``.

    Raises:
        OSError: the file cannot be written.
    """
    tables = [
        (table.name, list(table.rows[0]), [[format_value(v) for v in row.values()] for row in table.rows])
        for table in comparison.tables
    ]
    html = render_page(
        "diff.html.jinja",
        comparison=comparison,
        tables=tables,
        views=[_build_view(pair) for pair in comparison.pairs],
        scale=describe_scale(),
        max_error=f"{MAX_ERROR:g}",
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        part.write_text(html, encoding="utf-8")
    return path


def _make_strip(pair: PicturePair) -> NDArray[np.uint8]:
    parts = [pair.a, pair.b, color_errors(pair.a, pair.b)]
    if pair.truth is not None and pair.truth.shape == pair.a.shape:
        parts.append(pair.truth)
    return np.concatenate(parts, 1)


def _build_view(pair: PicturePair) -> _View:
    layers = [_Layer("A", _embed(pair.a)), _Layer("B", _embed(pair.b)), _error_layer("A − B", pair.a, pair.b)]
    if pair.truth is not None and pair.truth.shape == pair.a.shape:
        layers.append(_Layer("Truth", _embed(pair.truth)))
        layers.append(_error_layer("Error of A", pair.a, pair.truth))
        layers.append(_error_layer("Error of B", pair.b, pair.truth))
    return _View(pair.label[:1].upper() + pair.label[1:], layers)


def _error_layer(label: str, one: NDArray[np.uint8], other: NDArray[np.uint8]) -> _Layer:
    error: ErrorMap = compare_pixels(one, other)
    return _Layer(label, error.image, error.words)


def _embed(pixels: NDArray[np.uint8]) -> EmbeddedImage:
    return embed_photo(encode_png(pixels))
