"""Which images of a log a run leaves out and why: ``genre check`` and the stage ``ingest`` both judge by this."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from genre_tasks.errors import GenreError, InputError
from genre_tasks.logs.findings import Finding, format_frames
from genre_tasks.logs.types import Lens
from genre_tasks.scene.image_decoding import ImageFacts

UNREADABLE = "unreadable_image"
ODD_SIZE = "odd_image_size"
BLANK = "blank_image"
LEFT_OUT = (UNREADABLE, ODD_SIZE, BLANK)
"""Words of findings whose images are left out of a run."""

Decoded = TypeVar("Decoded")


def read_image(
    read: Callable[[], bytes | None], decode: Callable[[bytes], Decoded], errors: type[GenreError] = InputError
) -> tuple[Decoded | None, Finding | None]:
    """Reads and decodes an image, and makes a finding of the error where that fails.

    Args:
        read: gives the encoded file, or ``None`` where there is none.
        decode: decodes or inspects it.
        errors: those that become a finding; a run lets others pass, to be tried again.

    Returns:
        What ``decode`` returns, and no finding; or ``None`` and ``unreadable_image``; or twice ``None`` where there is
        no image.

    >>> read_image(lambda: None, len)
    (None, None)
    """
    try:
        data = read()
        return (None if data is None else decode(data)), None
    except errors as error:
        # The name alone: where the log lies must not change what a run stores.
        file = f" (file {Path(error.file).name})" if error.file else ""
        return None, Finding(UNREADABLE, "warning", error.problem + file, error.remedy)


def find_unfit(lens: Lens, facts: ImageFacts) -> Finding | None:
    """Finds why an image that can be decoded is of no use.

    Args:
        lens: the camera's, at the native size of its images.
        facts: of the image.

    Returns:
        ``odd_image_size`` or ``blank_image``, or ``None``.
    """
    # A crop, a thumbnail or another camera's image: the intrinsics of this camera would be wrong for it.
    if (facts.width_px, facts.height_px) != (lens.width_px, lens.height_px):
        size = f"{facts.width_px}×{facts.height_px}"
        message = f"the image is {size}, the camera's lens is {lens.width_px}×{lens.height_px}"
        remedy = "Images of another size than the intrinsics' are left out; export them at that size."
        numbers = {"width_px": facts.width_px, "height_px": facts.height_px}
        return Finding(ODD_SIZE, "warning", message, remedy, numbers)
    if facts.is_blank:
        message = "the image has one colour all over"
        remedy = "Such images are left out, since nothing can be learned from them; check the recording."
        return Finding(BLANK, "warning", message, remedy)
    return None


def summarise_findings(camera: str, found: Sequence[tuple[int, Finding]]) -> tuple[Finding, ...]:
    """Makes one finding of all of the same word: a camera's images mostly share what is wrong with them.

    Args:
        camera: whose images.
        found: frame and finding, in the order of frames.

    Returns:
        One finding for each word, with the message and numbers of the first one, and all frames.

    >>> note = Finding("reduced_depth", "note", "16 bits a sample are reduced to 8")
    >>> summarise_findings("front", [(3, note), (4, note)])[0].message
    'front: 16 bits a sample are reduced to 8 (frames 3–4)'
    """
    by_word: dict[str, list[tuple[int, Finding]]] = {}
    for frame, finding in found:
        by_word.setdefault(finding.word, []).append((frame, finding))
    return tuple(_summarise_word(camera, entries) for entries in by_word.values())


def _summarise_word(camera: str, entries: list[tuple[int, Finding]]) -> Finding:
    frames = tuple(frame for frame, _ in entries)
    first = entries[0][1]
    others = len({finding.message for _, finding in entries}) - 1
    more = f", with {others} other messages" if others else ""
    listed = format_frames(frames)
    message = f"{camera}: {first.message} (frames {listed}{more})"
    if first.word == UNREADABLE:
        message = f"{camera}: unreadable images at frames {listed}{more}: {first.message}"
    return replace(first, message=message, camera=camera, frames=frames)
