"""Table 7 as claims: scenes of the front camera, as detectors see them from the front-left one."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.run_stages import print_progress
from benchmarks.common.task import require_log_folder
from benchmarks.perception.scenes import (
    METHOD,
    OTHER_METHODS,
    PerceptionCase,
    drop_missing,
    list_detectors,
    restrict_to_front_camera,
    run_method,
)
from flows.paper_tables.agreement_cells import render_front_left
from flows.paper_tables.builtin_methods import BUILT_IN
from flows.perception.camera_transfer import DetectionPairs, agreement_metrics, detect_pairs
from genre_tasks.detection.agreement import Agreement, resample_images, summarise_matches
from genre_tasks.detection.detector import open_detector

MEASURES: Mapping[str, str] = {
    "ap": "average_precision",
    "recall": "recall",
    "iou": "matched_overlap",
    "iou_all": "mean_overlap",
}
"""Attributes of an agreement by the words of metrics."""

KINDS = ("box", "mask")
"""What agrees: boxes of all detectors, masks of those that have them."""

RESAMPLES = 1000
TRAINING_CHUNK = " chunk 0"
"""End of the name of the real log's chunk that networks were trained on: tables show it, and no claim is made of it."""


def measure_camera_transfer(case: PerceptionCase, folder: str, detectors: tuple[str, ...]) -> Row:
    """Measures all methods on a chunk with every detector.

    Args:
        case: the chunk, with all cameras.
        folder: that holds the detectors.
        detectors: names of their files.

    Returns:
        ``agreement``: metrics by detector and method; ``differences``: by detector, other method and metric, GenRe+
        less the other with the 95 % interval over images.

    Raises:
        NotMeasuredError: the log or a detector is missing.
    """
    require_log_folder(case.log)
    paths = list_detectors(folder, detectors)
    # The front-left camera stays unseen, as in the paper.
    front = restrict_to_front_camera(case)
    images = {}
    for method in (METHOD, *OTHER_METHODS):
        job, refs = run_method(front, method)
        images[method] = render_front_left(job, refs, BUILT_IN[method].end)
    agreement: dict[str, dict[str, Row]] = {}
    differences: list[Row] = []
    # One detector at a time, so that memory holds one network.
    for name, path in paths.items():
        detector = open_detector(str(path))
        pairs = {method: detect_pairs(detector, found) for method, found in images.items()}
        agreement[name] = {
            method: drop_missing(agreement_metrics([pair], has_masks=detector.has_masks))
            for method, pair in pairs.items()
        }
        for kind in KINDS if detector.has_masks else KINDS[:1]:
            differences += [
                _compare(pairs[METHOD], pairs[other], kind, measure) | {"detector": name, "other": other}
                for other in OTHER_METHODS
                for measure in MEASURES
            ]
        print_progress(f"{case.name} {name}: done")
    return {"kind": "transfer", "log": case.name, "agreement": agreement, "differences": differences}


def _compare(ours: DetectionPairs, others: DetectionPairs, kind: str, measure: str) -> Row:
    """The difference of one number, with its interval over images and the number of resamples that lack it."""
    matches = [pairs.match(of_masks=kind == "mask") for pairs in (ours, others)]
    differences: list[float] = []

    def difference(found: Sequence[Agreement]) -> float:
        first, second = (float(getattr(agreement, MEASURES[measure])) for agreement in found)
        # A method that finds nothing has no overlap of what it found, and there is no difference to count as a gain.
        differences.append(first - second)
        return differences[-1]

    value = difference([summarise_matches(images) for images in matches])
    bounds = resample_images(matches, difference, RESAMPLES)
    return {
        "measure": f"{kind}/{measure}",
        "mean": value if math.isfinite(value) else None,
        "interval": [bound if math.isfinite(bound) else None for bound in bounds],
        "undefined_resamples": sum(not math.isfinite(resampled) for resampled in differences[1:]),
    }


def camera_transfer_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that GenRe+ agrees better than each other method, in every number of the paper.

    A claim is about the difference; its spread is the 95 % interval over images. A number that no row has is claimed as
    not measured, and so is an IoU of found instances where a method finds nothing; the note counts such cases.

    Args:
        rows: see :func:`measure_camera_transfer`; those of training data make no claim.
    """
    rows = [row for row in rows if not row["log"].endswith(TRAINING_CHUNK)]
    measured = {(d["other"], d["measure"]) for row in rows for d in row["differences"]}
    for other, measure in itertools.product(OTHER_METHODS, (f"{kind}/{name}" for kind in KINDS for name in MEASURES)):
        if (other, measure) not in measured:
            yield claim(_claim_name(other, measure), None, ">", 0.0, "difference", "not measured")
    for row in rows:
        for difference in row["differences"]:
            # Unknown where too few images have a find.
            low, high = difference["interval"]
            yield claim(
                _claim_name(difference["other"], difference["measure"]),
                difference["mean"],
                ">",
                0.0,
                "difference",
                f"{row['log']}, {difference['detector']}, GenRe+ less {BUILT_IN[difference['other']].name}; spread: "
                f"95 % over images{_describe_undefined(difference, rows)}",
                1,
                None if low is None or high is None else (low, high),
            )


def _describe_undefined(difference: Row, rows: Sequence[Row]) -> str:
    """Says in how many cases and resamples the number does not exist; nothing where it always does."""
    means = [
        found["mean"]
        for row in rows
        for found in row["differences"]
        if (found["other"], found["measure"]) == (difference["other"], difference["measure"])
    ]
    undefined = means.count(None)
    text = f"; undefined in {undefined} of {len(means)} cases, where a method finds nothing" if undefined else ""
    # Rows of earlier versions do not have the count.
    dropped = difference.get("undefined_resamples", 0)
    return text + (f"; left out: {dropped} of {RESAMPLES} resamples without the number" if dropped else "")


def _claim_name(other: str, measure: str) -> str:
    return f"perception.transfer_{other}_{measure.replace('/', '_')}"


def camera_transfer_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each chunk, detector and method.

    Args:
        rows: see :func:`measure_camera_transfer`.
    """
    yield "| chunk | detector | method | kind | AP | recall | IoU | IoU, 0 where missed | instances |"
    yield "|---|---|---|---|---|---|---|---|---|"
    for row in rows:
        for detector, methods in row["agreement"].items():
            for method, metrics in methods.items():
                for kind in KINDS:
                    if f"{kind}/instances" not in metrics:
                        continue
                    values = [metrics.get(f"{kind}/{name}") for name in MEASURES]
                    texts = ["–" if value is None else f"{value:.3f}" for value in values]
                    count = int(metrics[f"{kind}/instances"])
                    line = [row["log"], detector, BUILT_IN[method].name, kind, *texts, str(count)]
                    yield f"| {' | '.join(line)} |"
