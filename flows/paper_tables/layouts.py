"""What each table consists of: its rows (methods, and the paper's names for them), columns and protocol."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from flows.paper_tables.methods import BUILT_IN, Method
from genre_tasks.errors import ConfigError

PROTOCOL = (
    "ingest.source_every=4",
    "novel_views.shifts_m=[3.0,-3.0]",
    "evaluate.shifts_m=[1.0,2.0,3.0,4.0,5.0]",
    "evaluate.every=1",
    "evaluate.distributions=true",
)
"""Paper Sec. IV-A: every fourth frame is given, the others judge; fixed at 3 m only; judged at 1 to 5 m, both sides."""

RECONSTRUCTION, FIXER, DISTILLATION = ("initial", "gnet"), ("novel_views", "fnet"), ("enet",)
"""The stages of the phases of the paper's table 5. Ingest and the plan of effects are said apart: they read the log."""
PREPARATION = ("ingest", "effects")


@dataclass(frozen=True)
class Cell:
    """A method on a chunk, measured.

    ``seconds`` and ``cpu_seconds`` by stage, as they were when the stage was computed (NaN where it was not counted);
    ``metrics`` by name, with ``…/n`` images and ``…/low``, ``…/high`` of an interval; ``fixed`` novel views.
    """

    method: str
    log: str
    chunk: int
    seconds: Mapping[str, float]
    cpu_seconds: Mapping[str, float]
    metrics: Mapping[str, float]
    gaussians: int
    fixed: int


Read = Callable[[Cell], float]


@dataclass(frozen=True)
class Column:
    """What is measured, and the paper's column beside it: ``paper`` its key, ``paper_label`` where it is not the same
    quantity. ``proper`` reads the paper's own quantity, which takes the column once it was measured."""

    key: str
    label: str
    read: Read
    digits: int = 2
    paper: str = ""
    paper_label: str = ""
    more_is_better: bool = False
    proper: Read | None = None


@dataclass(frozen=True)
class Row:
    """``paper``: the row's name in the paper, if it is there."""

    label: str
    method: Method
    paper: str = ""


@dataclass(frozen=True)
class Layout:
    """A table. ``beside``: columns that the paper does not have. ``ends``: where a method of it may end."""

    number: int
    rows: tuple[Row, ...]
    columns: tuple[Column, ...]
    beside: tuple[Column, ...]
    ends: tuple[str, ...] = ("gnet", "enet")
    protocol: tuple[str, ...] = PROTOCOL
    evaluated: bool = True
    said: tuple[str, ...] = ()


def metric(name: str) -> Read:
    """NaN where the evaluation has none."""
    return lambda cell: float(cell.metrics.get(name, math.nan))


def seconds_of(stages: Sequence[str]) -> Read:
    """Of those of the stages that the method has."""
    return lambda cell: float(sum(cell.seconds.get(s, 0.0) for s in stages))


def minutes_of(stages: Sequence[str]) -> Read:
    """As :func:`seconds_of`."""
    return lambda cell: seconds_of(stages)(cell) / 60


def seconds_a_frame(cell: Cell) -> float:
    """Of the fixer's stage: loading the network and encoding references are in it, rendering its inputs is not."""
    return cell.seconds["fnet"] / cell.fixed if cell.fixed else math.nan


def layout_of(number: int, own: Sequence[Method] = ()) -> Layout:
    """The table with the user's ``own`` methods as further rows.

    Raises ``ConfigError`` for a table that the paper does not have, or a method that does not end where it should.
    """
    if number not in LAYOUTS:
        raise ConfigError(
            f"there is no table {number}", remedy=f"Choose from {', '.join(map(str, LAYOUTS))} (paper Sec. IV)."
        )
    layout = LAYOUTS[number]
    for method in own:
        if method.end not in layout.ends:
            raise ConfigError(
                f"the method {method.name} ends at {method.end}",
                remedy=f"Table {number} takes methods that end at {' or '.join(layout.ends)}: set its `end`.",
            )
    rows = (*layout.rows, *(Row(m.name, m) for m in own))
    if len({r.label for r in rows}) < len(rows):
        raise ConfigError("two methods have one name", remedy="Give each method file a name of its own.")
    return Layout(**{**vars(layout), "rows": rows})


def _row(key: str, paper: str = "") -> Row:
    return Row(BUILT_IN[key].name, BUILT_IN[key], paper)


def _kernels(shifts: Sequence[int]) -> tuple[Column, ...]:
    return tuple(
        Column(
            f"kernel_{n}m",
            f"kernel @{n}m",
            metric(f"shift_{n}m/kernel"),
            3,
            f"fid_{n}m",
            f"FID @{n}m",
            proper=metric(f"shift_{n}m/fid"),
        )
        for n in shifts
    )


def _truth(shifts: Sequence[int]) -> tuple[Column, ...]:
    out = []
    for n in shifts:
        out.append(Column(f"psnr_{n}m", f"PSNR @{n}m", metric(f"shift_{n}m/psnr"), 2, more_is_better=True))
    for n in shifts:
        out.append(Column(f"perceptual_{n}m", f"perceptual @{n}m", metric(f"shift_{n}m/perceptual"), 3))
    for n in shifts:
        out.append(Column(f"lpips_{n}m", f"LPIPS @{n}m", metric(f"shift_{n}m/lpips"), 3))
    for n in shifts:
        out.append(Column(f"frechet_{n}m", f"Fréchet @{n}m", metric(f"shift_{n}m/frechet"), 2))
    return tuple(out)


_PSNR = Column("psnr", "PSNR, dB", metric("interpolation/psnr"), 2, "psnr", more_is_better=True)
_SSIM = Column("ssim", "SSIM", metric("interpolation/ssim"), 3, "ssim", more_is_better=True)
_HELD_OUT = (
    Column("psnr", "PSNR held out, dB", metric("interpolation/psnr"), 2, more_is_better=True),
    Column("ssim", "SSIM held out", metric("interpolation/ssim"), 3, more_is_better=True),
    Column("perceptual", "perceptual held out", metric("interpolation/perceptual"), 3),
    Column("lpips", "LPIPS held out", metric("interpolation/lpips"), 3),
)
_GAUSSIANS = Column("gaussians", "Gaussians", lambda cell: cell.gaussians, 0)
_ALL = (*RECONSTRUCTION, *FIXER, *DISTILLATION)
_SECONDS = Column("seconds", "seconds", seconds_of(_ALL), 1)
_PREPARING = Column("preparation_s", "ingest and plan, s", seconds_of(PREPARATION), 1)
_CPU_SECONDS = Column(
    "cpu_seconds", "CPU seconds", lambda cell: float(sum(cell.cpu_seconds.get(s, 0.0) for s in _ALL)), 1
)
_TIMES = (
    "Minutes are the wall time of initial scene and GNet's stage, and where there are any of novel views, fixer and "
    "distillation, as each was measured when it was computed; ingest and plan of effects are not in them."
)

LAYOUTS: Mapping[int, Layout] = {
    layout.number: layout
    for layout in (
        Layout(
            1,
            (
                _row("3dgs", "3DGS"),
                _row("streetgs", "StreetGS"),
                _row("splatad", "SplatAD"),
                _row("g3r", "G3R"),
                _row("gnet", "Ours (GNet)"),
                _row("streetcrafter", "StreetCrafter"),
                _row("difix", "Difix3D"),
                _row("genre+", "Ours (GenRe+)"),
            ),
            (_PSNR, _SSIM, *_kernels((1, 2, 3, 4, 5)), Column("minutes", "minutes", minutes_of(_ALL), 2, "minutes")),
            (*_HELD_OUT[2:], *_truth((1, 3, 5)), _CPU_SECONDS, _GAUSSIANS),
            said=(_TIMES,),
        ),
        Layout(
            2,
            (
                _row("3dgs", "3DGS"),
                _row("3dgs+genre", "3DGS + GenRe"),
                _row("g3r", "G3R"),
                _row("g3r+genre", "G3R + GenRe (zero-shot)"),
                _row("g3r+genre-tuned", "G3R + GenRe (fine-tune)"),
            ),
            _kernels((0, 1, 2, 3)),
            (*_HELD_OUT, *_truth((1, 3)), _SECONDS),
            said=("At 0 m the set is that of the held-out frames.",),
        ),
        Layout(
            3,
            (
                _row("fixer-streetcrafter", "StreetCrafter (V)"),
                _row("fixer-difix", "Difix3D (Fixer)"),
                _row("fnet", "Ours (FNet)"),
            ),
            (
                *_kernels((1, 2, 3)),
                Column("s_per_frame", "s/frame", seconds_a_frame, 3, "s_per_frame"),
            ),
            (
                *(
                    Column(
                        f"render_kernel_{n}m", f"kernel of the renders @{n}m", metric(f"shift_{n}m/render_kernel"), 3
                    )
                    for n in (1, 2, 3)
                ),
                *_truth((1, 2, 3)),
            ),
            ends=("fnet",),
            protocol=(*PROTOCOL, "novel_views.shifts_m=[1.0,-1.0,2.0,-2.0,3.0,-3.0]"),
            said=(
                "Each fixer gets GNet's renders of the source frames, moved by 1, 2 and 3 m to both sides; its images "
                "are compared as a set with all real images of the chunk. Seconds a frame are the stage's, loading the "
                "network and encoding references in them, over its images.",
            ),
        ),
        Layout(
            4,
            (
                _row("gnet", "GNet"),
                _row("gnet-gnet", "GNet → FNet → GNet"),
                _row("gnet-enet", "GNet → FNet → ENet"),
            ),
            _kernels((1, 2, 3, 4, 5)),
            (*_HELD_OUT, *_truth((1, 3, 5)), _SECONDS),
        ),
        Layout(
            5,
            (_row("difix", "Difix3D"), _row("genre+", "GenRe+")),
            (
                Column("reconstruction", "reconstruction", minutes_of(RECONSTRUCTION), 3, "reconstruction"),
                Column("fixer", "neural fixer", minutes_of(FIXER), 3, "fixer"),
                Column("distillation", "distillation", minutes_of(DISTILLATION), 3, "distillation"),
                Column("total", "total", minutes_of(_ALL), 3, "total"),
            ),
            (_PREPARING, _CPU_SECONDS, _GAUSSIANS),
            evaluated=False,
            said=(
                "Minutes of wall time. Reconstruction: initial scene and GNet's stage; fixer: rendering the novel "
                "views and fixing them; distillation: ENet's stage. Ingest and plan of effects are not in the total.",
            ),
        ),
    )
}
