"""The worst pictures of a dataset: of the chunks with the lowest accuracy, the view that is farthest from its truth."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from flows.pipeline.log_cache import cached_log
from genre_tasks.errors import GenreError
from storage.address import Address

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from storage.store import Artifact, Store

COUNT = 12
"""How many views there are at most, one a log, so that the report of a thousand logs stays small."""

WIDTH_PX = 640
"""Wider pictures are scaled down."""

_SCENE_STAGES = ("initial", "gnet", "enet")
_ATTEMPTS = 2
_ACCURACY = "interpolation/psnr"
_TRUTH = ".truth"


@dataclass(frozen=True)
class WorstView:
    """A picture that differs much from its truth.

    Attributes:
        log: the log's URI.
        run: the run's name.
        chunk: number of the chunk.
        stage: the stage that made the scene.
        name: of the picture in the evaluation, with shift, camera and frame.
        psnr: of this picture, dB.
        picture: bytes of a PNG file.
        truth: bytes of a PNG file.
    """

    log: str
    run: str
    chunk: int
    stage: str
    name: str
    psnr: float
    picture: bytes
    truth: bytes


class _Candidate(NamedTuple):
    """A chunk whose pictures may be among the worst."""

    psnr: float
    log: str
    run: str
    chunk: int
    stage: str
    key: str


def find_worst_views(store: Store, records: Iterable[Mapping[str, Any]], count: int = COUNT) -> tuple[WorstView, ...]:
    """Finds the worst pictures of the logs with the lowest accuracy on held-out frames.

    Only as many evaluations are read as there are views. One that is gone or damaged is left out.

    Args:
        store: the store of the runs.
        records: of the runs.
        count: how many logs at most.

    Returns:
        One view of each of these logs, the worst picture first.
    """
    # By log: the chunk of the lowest accuracy stands for it.
    by_log: dict[str, _Candidate] = {}
    for record in records:
        for candidate in _list_candidates(record):
            by_log[candidate.log] = min(candidate, by_log.get(candidate.log, candidate))
    views: list[WorstView] = []
    # Where the evaluations are gone, those of all other logs probably are, too.
    for candidate in sorted(by_log.values())[: _ATTEMPTS * count]:
        if len(views) == count:
            break
        view = _read_worst_view(store, candidate)
        if view is not None:
            views.append(view)
    return tuple(sorted(views, key=lambda view: view.psnr))


def _list_candidates(record: Mapping[str, Any]) -> list[_Candidate]:
    found = []
    for chunk in record["chunks"]:
        stages = {stage["stage"]: stage for stage in chunk["stages"]}
        for stage in reversed(_SCENE_STAGES):
            evaluation = stages.get(f"evaluate/{stage}")
            psnr = stages.get(stage, {}).get("metrics", {}).get(_ACCURACY)
            if evaluation is not None and isinstance(psnr, int | float) and math.isfinite(psnr):
                found.append(_Candidate(psnr, record["log"], record["run"], chunk["chunk"], stage, evaluation["key"]))
                break
    return found


def _read_worst_view(store: Store, candidate: _Candidate) -> WorstView | None:
    try:
        artifact = _find_evaluation(store, candidate)
        pictures = {} if artifact is None else store.read(artifact).pictures
    except GenreError:
        # The log's metrics are in the table all the same; `genre verify` says what is damaged.
        return None
    scored = [
        (_measure_psnr(pictures[name], pictures[name + _TRUTH]), name)
        for name in pictures
        if name + _TRUTH in pictures and pictures[name].shape == pictures[name + _TRUTH].shape
    ]
    if not scored:
        return None
    psnr, name = min(scored)
    return WorstView(
        log=candidate.log,
        run=candidate.run,
        chunk=candidate.chunk,
        stage=candidate.stage,
        name=name,
        psnr=psnr,
        picture=_encode_png(pictures[name]),
        truth=_encode_png(pictures[name + _TRUTH]),
    )


def _find_evaluation(store: Store, candidate: _Candidate) -> Artifact | None:
    stage = f"evaluate/{candidate.stage}"
    try:
        log = cached_log(candidate.log)
    except GenreError:
        # The log is on the machines of the workers alone: the store is searched, which takes longer.
        return next(store.artifacts(chunk=candidate.chunk, stage=stage, key=candidate.key), None)
    return store.find(Address(log.dataset, log.name, candidate.chunk, stage, candidate.key))


def _measure_psnr(pixels: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    import numpy as np

    mean_square = float(np.mean((pixels.astype(np.float64) - truth.astype(np.float64)) ** 2)) / 255**2
    return math.inf if mean_square == 0 else -10 * math.log10(mean_square)


def _encode_png(pixels: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    image = Image.fromarray(pixels)
    if image.width > WIDTH_PX:
        image = image.resize((WIDTH_PX, max(1, round(image.height * WIDTH_PX / image.width))))
    sink = io.BytesIO()
    image.save(sink, "PNG")
    return sink.getvalue()
