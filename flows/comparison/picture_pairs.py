"""Pictures of the same viewpoint in two artifacts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from flows.comparison.comparison import PicturePair
from flows.reconstruction.report.viewpoints import describe_viewpoint

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from storage.store import Artifact

_TRUTH = ".truth"
MOST_PAIRS = 12
"""Of many views so many are compared, at equal distances."""


def pair_pictures(a: Artifact, b: Artifact, heading: str = "") -> list[PicturePair]:
    """Pairs the images of two artifacts of one kind by viewpoint.

    Args:
        a: an evaluation, novel views or fixed views.
        b: the same kind; its payload is verified, as is that of ``a``.
        heading: how the labels of the pairs begin, such as ``chunk 0 after enet``; their names begin so, too.

    Returns:
        The pairs of equal size, at most :data:`MOST_PAIRS`; empty for kinds without images.

    Raises:
        ArtifactCorruptError: an image is damaged.
    """
    list_pairs = {"evaluation": _pair_evaluation, "novel_views": _pair_views, "fixed_views": _pair_views}
    pairs = list_pairs.get(a.manifest.kind)
    if pairs is None:
        return []
    found = [pair for pair in pairs(a, b) if pair.a.shape == pair.b.shape]
    if not heading:
        return found
    slug = heading.replace(" ", "-")
    return [replace(pair, name=f"{slug}-{pair.name}", label=f"{heading} · {pair.label}") for pair in found]


def _pair_evaluation(a: Artifact, b: Artifact) -> Iterator[PicturePair]:
    from storage.codecs.png import read_png

    folders = (a.path / "pictures", b.path / "pictures")
    names = [{path.name.removesuffix(".png") for path in folder.glob("*.png")} for folder in folders]
    for name in sorted(name for name in names[0] & names[1] if not name.endswith(_TRUTH))[:MOST_PAIRS]:
        truth = folders[0] / f"{name}{_TRUTH}.png"
        yield PicturePair(
            name=name,
            label=describe_viewpoint(name),
            a=read_png(folders[0] / f"{name}.png"),
            b=read_png(folders[1] / f"{name}.png"),
            truth=read_png(truth) if truth.is_file() else None,
        )


def _pair_views(a: Artifact, b: Artifact) -> Iterator[PicturePair]:
    from flows.plots.artifact_pictures import spread_indices

    files_a = _view_files(a)
    files_b = _view_files(b)
    common = [key for key in files_a if key in files_b]
    for index in spread_indices(len(common), MOST_PAIRS):
        camera, frame, shift_m = common[index]
        yield PicturePair(
            name=f"{camera}_{frame:04d}_{shift_m:+.2f}m",
            label=f"{abs(shift_m):g} m to the {'left' if shift_m > 0 else 'right'} · {camera.replace('_', ' ')}"
            f" · frame {frame}",
            a=_read_view(a, *files_a[common[index]]),
            b=_read_view(b, *files_b[common[index]]),
        )


def _view_files(artifact: Artifact) -> dict[tuple[str, int, float], tuple[Path, tuple[int, int]]]:
    """File and (height, width) of each view, by camera, frame and shift."""
    from storage.codecs.novel_views import read_view_table

    views, files, shape = read_view_table(artifact.path)
    return {(v.camera, v.frame, v.shift_m): (file, shape) for v, file in zip(views, files, strict=True)}


def _read_view(artifact: Artifact, file: Path, shape: tuple[int, int]) -> NDArray[np.uint8]:
    from flows.plots.artifact_pictures import to_uint8

    if artifact.manifest.kind == "fixed_views":
        from storage.codecs import fixed_views

        return to_uint8(fixed_views.read_image(file, shape))
    from storage.codecs import novel_views

    return to_uint8(novel_views.read_image(file, shape)[""][0])
