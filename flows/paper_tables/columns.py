"""A table's cells once they are measured, and its columns: what each reads off a cell."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from flows.paper_tables.rollouts import BEHAVIOUR_LABELS

RECONSTRUCTION = ("initial", "gnet")
FIXER = ("novel_views", "fnet")
DISTILLATION = ("enet",)
"""The stages of the three phases of the paper's table 5."""
PREPARATION = ("ingest", "effects")
"""Stages that read the log; the paper's times do not include them, so they have a column of their own."""
ALL_PHASES = (*RECONSTRUCTION, *FIXER, *DISTILLATION)

LPIPS_NAMES = (("lpips", "LPIPS"), ("lpips_alex", "LPIPS Alex"), ("lpips_vgg", "LPIPS VGG"))
"""Metric and heading of LPIPS: by a network of the user's, and by those with a name."""

_LPIPS = tuple((name, label, 3) for name, label in LPIPS_NAMES)


@dataclass(frozen=True)
class MeasuredCell:
    """A method on a chunk, measured.

    Attributes:
        method: label of the row.
        log: URI of the log.
        chunk: index of the chunk; ``None`` for all measured chunks of the log together.
        seconds: wall seconds by stage, as they were when the stage was computed.
        cpu_seconds: CPU seconds by stage; NaN where they were not counted.
        metrics: by name, with ``…/n`` images and ``…/low``, ``…/high`` of 95 % intervals.
        gaussians: number of Gaussians of the scene.
        fixed_views: number of novel views that were fixed.
        remarks: what the reader should know of this cell, a clause each.
    """

    method: str
    log: str
    chunk: int | None
    seconds: Mapping[str, float]
    cpu_seconds: Mapping[str, float]
    metrics: Mapping[str, float]
    gaussians: int
    fixed_views: int
    remarks: tuple[str, ...] = ()


Reader = Callable[[MeasuredCell], float]
"""Reads a number off a cell; NaN where the cell has none."""


@dataclass(frozen=True)
class Column:
    """A column of measured numbers, beside the paper's where it has one.

    Attributes:
        key: name of the column.
        label: its heading.
        read: what is measured.
        digits: decimals that are printed.
        paper: key of the paper's column.
        paper_label: heading of the paper's column where it is another quantity.
        more_is_better: whether a larger number is better.
        read_papers_quantity: reads the quantity of the paper; where it was measured, it takes the column.
    """

    key: str
    label: str
    read: Reader
    digits: int = 2
    paper: str = ""
    paper_label: str = ""
    more_is_better: bool = False
    read_papers_quantity: Reader | None = None


def read_metric(name: str) -> Reader:
    """Makes a reader of a metric such as ``interpolation/psnr``."""
    return lambda cell: float(cell.metrics.get(name, math.nan))


def sum_seconds(stages: Sequence[str]) -> Reader:
    """Makes a reader of the wall seconds of those of the stages that a method has."""
    # A method that ends before a stage spends nothing on it, which is a zero and not a gap.
    return lambda cell: float(sum(cell.seconds.get(s, 0.0) for s in stages))


def sum_minutes(stages: Sequence[str]) -> Reader:
    """Makes a reader of wall minutes, see :func:`sum_seconds`."""
    return lambda cell: sum_seconds(stages)(cell) / 60


def sum_cpu_seconds(stages: Sequence[str]) -> Reader:
    """Makes a reader of CPU seconds, see :func:`sum_seconds`."""
    return lambda cell: float(sum(cell.cpu_seconds.get(s, 0.0) for s in stages))


def seconds_per_fixed_view(cell: MeasuredCell) -> float:
    """Divides the seconds of the fixer's stage by its images.

    Loading the network and encoding references are in it, rendering its inputs is not.

    >>> seconds_per_fixed_view(MeasuredCell("FNet", "log", 0, {"fnet": 3.0}, {}, {}, 1000, fixed_views=6))
    0.5
    """
    # Loading the network is in them, so a short chunk has more seconds a view than a long one.
    # A gate may have left every view as it is.
    return cell.seconds["fnet"] / cell.fixed_views if cell.fixed_views else math.nan


def mean_over_cells(column: Column, cells: Sequence[MeasuredCell]) -> float:
    """Averages a column over chunks.

    Args:
        column: what to average.
        cells: of one method.

    Returns:
        The mean; NaN without a cell, or where one of them has no number.
    """
    # A cell without the number makes the mean NaN: a mean over fewer chunks would not compare with other rows.
    values = [column.read(c) for c in cells]
    # The exact sum does not depend on the order of chunks, so a resumed table prints the same digits.
    return math.fsum(values) / len(values) if values else math.nan


def kernel_columns(shifts_m: Sequence[int]) -> tuple[Column, ...]:
    """Makes columns of the kernel distance at each shift, in the place of the paper's FID."""
    return tuple(
        Column(
            # FID is biased by the number of images; the kernel distance is unbiased at any number.
            f"kernel_{n}m",
            f"kernel @{n}m",
            read_metric(f"shift_{n}m/kernel"),
            digits=3,
            paper=f"fid_{n}m",
            paper_label=f"FID @{n}m",
            read_papers_quantity=read_metric(f"shift_{n}m/fid"),
        )
        for n in shifts_m
    )


def truth_columns(shifts_m: Sequence[int]) -> tuple[Column, ...]:
    """Makes columns of what is measured against true images at each shift, which only synthetic logs have."""
    columns = [
        Column(f"psnr_{n}m", f"PSNR @{n}m", read_metric(f"shift_{n}m/psnr"), 2, more_is_better=True) for n in shifts_m
    ]
    for name, label, digits in (("perceptual", "perceptual", 3), *_LPIPS, ("frechet", "Fréchet", 2)):
        columns += [
            Column(f"{name}_{n}m", f"{label} @{n}m", read_metric(f"shift_{n}m/{name}"), digits) for n in shifts_m
        ]
    return tuple(columns)


def behaviour_columns() -> tuple[Column, ...]:
    """Makes columns of the kernel distance of each behaviour's rollouts, in the place of the paper's FID."""
    return tuple(
        Column(
            f"kernel_{behaviour}",
            f"kernel {label}",
            read_metric(f"{behaviour}/kernel"),
            digits=3,
            paper=f"fid_{behaviour}",
            paper_label=f"FID {label}",
            read_papers_quantity=read_metric(f"{behaviour}/fid"),
        )
        for behaviour, label in BEHAVIOUR_LABELS.items()
    )


def behaviour_truth_columns() -> tuple[Column, ...]:
    """Makes columns of what is measured against true images along rollouts, and of the Fréchet distance."""
    columns = []
    for name, label, digits in (
        ("psnr", "PSNR", 2),
        ("perceptual", "perceptual", 3),
        ("ssim", "SSIM", 3),
        *_LPIPS,
        ("frechet", "Fréchet", 2),
    ):
        better = name in ("psnr", "ssim")
        columns += [
            Column(
                f"{name}_{behaviour}",
                f"{label} {words}",
                read_metric(f"{behaviour}/{name}"),
                digits,
                more_is_better=better,
            )
            for behaviour, words in BEHAVIOUR_LABELS.items()
        ]
    return tuple(columns)


def agreement_columns(kind: str) -> tuple[Column, ...]:
    """Makes columns of how far a detector's finds on renders agree with those on recorded images.

    Args:
        kind: ``box`` or ``mask``.
    """
    return tuple(
        Column(
            f"{kind}_{name}",
            f"{kind} {heading}",
            read_metric(f"{kind}/{name}"),
            digits=3,
            paper=f"{kind}_{name}",
            more_is_better=True,
        )
        for name, heading in (("ap", "AP"), ("recall", "recall"), ("iou", "IoU"))
    )


def agreement_count_columns() -> tuple[Column, ...]:
    """Makes columns of the overlap over all instances, and of their number."""
    columns = []
    for kind in ("box", "mask"):
        overlap = read_metric(f"{kind}/iou_all")
        columns += [
            Column(f"{kind}_iou_all", f"{kind} IoU, 0 where missed", overlap, 3, more_is_better=True),
            Column(f"{kind}_instances", f"{kind} instances", read_metric(f"{kind}/instances"), 0),
        ]
    return tuple(columns)
