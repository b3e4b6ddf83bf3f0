"""Tables of the page on perception, from ``genre bench perception``."""

from __future__ import annotations

from statistics import mean
from typing import Any

from docs.result_tables import claims as claims_of
from docs.result_tables import provenance, result, table

_NAMES = {"genre+": "GenRe+", "3dgs": "3DGS", "difix": "Difix3D-style"}
_ROWS = {"real": "recorded images", "real+3dgs": "and renders of 3DGS", "real+genre+": "and renders of GenRe+"}
_NUMBERS = ("ap", "recall", "iou", "iou_all")


def _rows(kind: str) -> list[dict[str, Any]]:
    return [row for row in result("perception")["rows"] if row.get("kind") == kind]


def claims() -> str:
    """All claims on perception."""
    return claims_of("perception", several="cases")


def transfer() -> str:
    """Agreement across cameras by chunk, detector and method."""
    lines = []
    for row in _rows("transfer"):
        for detector, methods in row["agreement"].items():
            for method, name in _NAMES.items():
                metrics = methods[method]
                for kind in ("box", "mask"):
                    # A detector without masks has no such numbers.
                    if f"{kind}/instances" in metrics:
                        values = [_text(metrics.get(f"{kind}/{number}")) for number in _NUMBERS]
                        count = str(int(metrics[f"{kind}/instances"]))
                        lines.append([row["log"], detector, kind, name, *values, count])
    head = ["chunk", "detector", "of", "method", "AP", "recall", "IoU", "IoU, 0 where missed", "instances"]
    return table(head, lines) + "\n" + provenance("perception")


def differences() -> str:
    """By how much GenRe+ agrees better than other methods, with intervals over images."""
    lines = []
    for row in _rows("transfer"):
        for found in row["differences"]:
            low, high = found["interval"]
            known = found["mean"] is not None and low is not None
            interval = f"{low:.3f} to {high:.3f}" if known else "–"
            name = _NAMES[found["other"]]
            lines.append([row["log"], found["detector"], name, found["measure"], _text(found["mean"]), interval])
    head = ["chunk", "detector", "GenRe+ minus", "number", "difference", "95 % interval"]
    return table(head, lines) + "\n" + provenance("perception")


def shifts() -> str:
    """Box AP against the truth of streets over shift, the mean of all streets."""
    rows = _rows("shifts")
    lines = []
    for detector in sorted({name for row in rows for name in row["agreement"]}):
        for method in ("genre+", "3dgs"):
            curves = [row["agreement"][detector][method] for row in rows]
            values = []
            # JSON has shifts as text.
            for shift in ("0", "1", "2", "3", "4", "5"):
                found = [curve[shift]["box/ap"] for curve in curves if "box/ap" in curve.get(shift, {})]
                values.append(_text(mean(found) if found else None))
            lines.append([detector, _NAMES[method], *values])
    head = ["detector", "method", *(f"{shift} m" for shift in range(6))]
    return table(head, lines) + "\n" + provenance("perception")


def ranges() -> str:
    """How far the guards call scenes reliable, and a detector's agreement there."""
    # Imported here: the other tables do without the renderer.
    from benchmarks.perception.shifts import agreement_at_range

    found = {row["log"]: row for row in _rows("range")}
    lines = []
    for row in _rows("shifts"):
        # The range takes longer than all else, and is measured on a few streets.
        if row["log"] not in found:
            continue
        reach = found[row["log"]]
        for detector in sorted(row["agreement"]):
            on_path = row["agreement"][detector]["genre+"]["0"].get("box/ap")
            there = agreement_at_range(row, found, detector)
            sides = f"{reach['left_m']:.1f}, {reach['right_m']:.1f}"
            lines.append([row["log"], sides, detector, _text(on_path), _text(there)])
    head = ["street", "usable to the left and right, m", "detector", "AP on the path", "AP where the range ends"]
    return table(head, lines) + "\n" + provenance("perception")


def training() -> str:
    """Scores of detectors that were trained with and without renders: mean over seeds, with least and most."""
    rows = _rows("training")
    lines = []
    for size in sorted({_size_of(row) for row in rows}, reverse=True):
        # As in the paper first, then where the paper has no truth.
        for tested in ("recorded", "shifted"):
            lines += _training_lines([row for row in rows if _size_of(row) == size], tested)
    head = [
        "streets",
        "steps",
        "hidden up to",
        "trained on",
        "tested on",
        "mAP",
        "AP@1m",
        "AP@2m",
        "AP@4m",
        "mAP of cars",
        "seeds",
    ]
    return table(head, lines) + "\n" + provenance("perception")


def _size_of(row: dict[str, Any]) -> tuple[int, int, float]:
    return row["train_logs"], row["steps"], row.get("max_occluded", 1.0)


def _training_lines(rows: list[dict[str, Any]], tested: str) -> list[list[str]]:
    lines = []
    for images, words in _ROWS.items():
        scores = [row["scores"][tested] for row in rows if row["images"] == images and tested in row["scores"]]
        if not scores:
            continue
        cells = []
        for name in ("map", "ap_1m", "ap_2m", "ap_4m", "map_car"):
            values = [found[name] for found in scores]
            cells.append(f"{mean(values):.3f} ({min(values):.3f} to {max(values):.3f})")
        streets, steps, hidden = _size_of(rows[0])
        lines.append([str(streets), str(steps), f"{hidden:g}", words, tested, *cells, str(len(scores))])
    return lines


def speed() -> str:
    """Seconds of detectors for three cameras of a chunk."""
    lines = [
        [name, str(row["images"]), f"{sorted(seconds)[len(seconds) // 2]:.1f}"]
        for row in _rows("speed")
        for name, seconds in row["seconds"].items()
    ]
    return table(["detector", "images", "seconds, median"], lines) + "\n" + provenance("perception")


def _text(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
