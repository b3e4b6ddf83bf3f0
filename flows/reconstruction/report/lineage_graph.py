"""What was made from what: a table with all inputs, and a graph with those that no other path implies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from flows.reconstruction.run_summary import StageSummary

_STEP_X = 118.0
_STEP_Y = 54.0
_BOX = (96.0, 30.0)
_MARGIN = 6.0
_EVALUATE = "evaluate/"


@dataclass(frozen=True)
class LineageRow:
    """One artifact in the table.

    Attributes:
        stage: the stage's name.
        key: the artifact's key.
        made_from: names of the stages that it was made from, and ``log`` where the log was read.
        payload_digest: of its files.
        size: of its files, for readers.
        made_at: when it was made.
        code: the first digits of the digest of the stage's code.
        weights: the same of the network's weights; empty without a network.
    """

    stage: str
    key: str
    made_from: tuple[str, ...]
    payload_digest: str
    size: str
    made_at: str
    code: str
    weights: str


@dataclass(frozen=True)
class LineageGraph:
    """The graph, in the coordinates of an SVG.

    Attributes:
        width: of the SVG.
        height: of the SVG.
        boxes: (x, y, width, height, label, tooltip) of each artifact.
        edges: paths from an input to what was made of it.
        words: the graph as sentences.
    """

    width: float
    height: float
    boxes: tuple[tuple[float, float, float, float, str, str], ...]
    edges: tuple[str, ...]
    words: str


def build_lineage_rows(stages: Sequence[StageSummary]) -> list[LineageRow]:
    """Lists the artifacts of a chunk with what they were made from.

    Args:
        stages: of a chunk, in the order in which they ran; those without an origin are left out.

    Returns:
        The rows in that order.
    """
    rows = []
    for stage in stages:
        origin = stage.origin
        if origin is None:
            continue
        rows.append(
            LineageRow(
                stage=stage.stage,
                key=stage.key,
                made_from=tuple(origin.inputs),
                payload_digest=origin.payload_digest,
                size=format_bytes(origin.size_bytes),
                made_at=origin.made_at[:19].replace("T", " "),
                code=origin.code_digest[:8],
                weights=(origin.weights_digest or "")[:8],
            )
        )
    return rows


def draw_lineage(stages: Sequence[StageSummary]) -> LineageGraph | None:
    """Places the artifacts of a chunk from left to right, each behind what it was made from.

    Args:
        stages: of a chunk, in the order in which they ran.

    Returns:
        The graph, or ``None`` without any stage whose origin is known.
    """
    known = {stage.stage: stage for stage in stages if stage.origin is not None}
    inputs = {name: [i for i in s.origin.inputs if i in known] for name, s in known.items() if s.origin is not None}
    if not known:
        return None
    nearest = _leave_out_implied(inputs)
    columns: dict[str, int] = {}
    for name in known:
        # Stages come after what they read, so every input has its column already.
        columns[name] = max((columns.get(i, 0) + 1 for i in nearest[name]), default=0)
    rows = {name: int(name.startswith(_EVALUATE)) for name in known}
    corners = {n: (_MARGIN + columns[n] * _STEP_X, _MARGIN + rows[n] * _STEP_Y) for n in known}
    boxes = tuple(
        (
            *corners[name],
            *_BOX,
            name.removeprefix(_EVALUATE) if not rows[name] else "evaluation",
            f"{name} {s.key[:12]}",
        )
        for name, s in known.items()
    )
    edges = tuple(_draw_edge(corners[i], corners[name]) for name in known for i in nearest[name])
    words = "; ".join(f"{name} from {', '.join(nearest[name])}" for name in known if nearest[name])
    return LineageGraph(
        width=2 * _MARGIN + max(columns.values()) * _STEP_X + _BOX[0],
        height=2 * _MARGIN + max(rows.values()) * _STEP_Y + _BOX[1],
        boxes=boxes,
        edges=edges,
        words=words,
    )


def format_bytes(count: int) -> str:
    """Writes a size for readers.

    Args:
        count: bytes.

    Returns:
        KiB or MiB with three digits.

    >>> format_bytes(1_249_201)
    '1.19 MiB'
    """
    return f"{count / 2**20:.3g} MiB" if count >= 2**20 else f"{count / 2**10:.3g} KiB"


def _leave_out_implied(inputs: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """Inputs without those that another input was made from: every stage reads the chunk, which says nothing."""

    def ancestors(name: str) -> set[str]:
        return {a for i in inputs[name] for a in ({i} | ancestors(i))}

    return {
        name: [i for i in direct if not any(i in ancestors(other) for other in direct if other != i)]
        for name, direct in inputs.items()
    }


def _draw_edge(start: tuple[float, float], end: tuple[float, float]) -> str:
    width, height = _BOX
    x1 = start[0] + width
    y1 = start[1] + height / 2
    y2 = end[1] + height / 2
    middle = (x1 + end[0]) / 2
    return f"M{x1:g},{y1:g} C{middle:g},{y1:g} {middle:g},{y2:g} {end[0]:g},{y2:g}"
