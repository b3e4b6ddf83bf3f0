"""What each table consists of: its rows (methods, and the paper's names for them), columns and protocol."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from flows.paper_tables.builtin_methods import BUILT_IN
from flows.paper_tables.columns import (
    ALL_PHASES,
    DISTILLATION,
    FIXER,
    LPIPS_NAMES,
    PREPARATION,
    RECONSTRUCTION,
    Column,
    agreement_columns,
    agreement_count_columns,
    behaviour_columns,
    behaviour_truth_columns,
    kernel_columns,
    read_metric,
    seconds_per_fixed_view,
    sum_cpu_seconds,
    sum_minutes,
    sum_seconds,
    truth_columns,
)
from flows.paper_tables.methods import Method
from flows.paper_tables.published_numbers import PAPER
from flows.paper_tables.rollouts import TABLE_ROLLOUTS, TableRollout
from genre_tasks.errors import ConfigError

PROTOCOL = (
    "ingest.source_every=4",
    "novel_views.shifts_m=[3.0,-3.0]",
    "evaluate.shifts_m=[1.0,2.0,3.0,4.0,5.0]",
    "evaluate.every=1",
    "evaluate.distributions=true",
)
"""Paper Sec. IV-A: every fourth frame is a source, the others are held out; novel views are fixed at 3 m only and
evaluated at 1 to 5 m on both sides."""

SIMULATION_PROTOCOL = (*PROTOCOL, "evaluate.every=2")
"""Of table 6: every second pose of a rollout is rendered."""


@dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes:
        label: its heading.
        method: what is measured.
        paper: the row's name in the paper, if it is there.
    """

    label: str
    method: Method
    paper: str = ""


@dataclass(frozen=True)
class Layout:
    """A table.

    Attributes:
        number: in the paper.
        rows: in the paper's order, then the user's.
        columns: the paper's.
        extra_columns: what the paper does not have.
        ends: stages where a method of this table may end.
        protocol: ``section.key=value`` over the preset, for all methods.
        evaluated: whether scenes or images are evaluated; a table of times needs none.
        notes: sentences below the table.
        rollouts: what a method is measured along, on all chunks of a log together; none where every chunk is a cell.
        across_cameras: whether scenes are of the front camera alone, and detectors compare the front-left one's images.
    """

    number: int
    rows: tuple[Row, ...]
    columns: tuple[Column, ...]
    extra_columns: tuple[Column, ...]
    ends: tuple[str, ...] = ("gnet", "enet")
    protocol: tuple[str, ...] = PROTOCOL
    evaluated: bool = True
    notes: tuple[str, ...] = ()
    rollouts: tuple[TableRollout, ...] = ()
    across_cameras: bool = False


def get_layout(number: int, user_methods: Sequence[Method] = (), *, of_scene: bool = False) -> Layout:
    """Gives a table of the paper.

    Args:
        number: of the table.
        user_methods: further rows.
        of_scene: whether a scene of another program is measured, and not reconstructions of logs.

    Raises:
        ConfigError: the paper has no such table, it has none of a scene, a method ends at a stage that the table
            does not show, or two methods have one name.
    """
    if number not in LAYOUTS:
        raise ConfigError(
            f"there is no table {number}", remedy=f"Choose from {', '.join(map(str, PAPER))} (paper Sec. IV)."
        )
    if of_scene and number not in SCENE_LAYOUTS:
        raise ConfigError(
            f"table {number} compares what is reconstructed from logs, and takes no scene",
            remedy="Use `genre table 2 --scene FILE`, or give logs in the place of --scene.",
        )
    layout = SCENE_LAYOUTS[number] if of_scene else LAYOUTS[number]
    # Checked here, where the error can still name the file's method and the table's ends.
    for method in user_methods:
        # A fixer's images cannot be compared with renders in the same column.
        if method.end not in layout.ends:
            raise ConfigError(
                f"the method {method.name} ends at {method.end}",
                remedy=f"Table {number} takes methods that end at {' or '.join(layout.ends)}: set its `end`.",
            )
    rows = (*layout.rows, *(Row(m.name, m) for m in user_methods))
    # Cells find their row by its label, so two equal ones would share their numbers.
    if len({r.label for r in rows}) < len(rows):
        raise ConfigError("two methods have one name", remedy="Give each method file a name of its own.")
    return replace(layout, rows=rows)


def _row(key: str, paper: str = "") -> Row:
    return Row(BUILT_IN[key].name, BUILT_IN[key], paper)


_PSNR = Column("psnr", "PSNR, dB", read_metric("interpolation/psnr"), 2, paper="psnr", more_is_better=True)
_SSIM = Column("ssim", "SSIM", read_metric("interpolation/ssim"), 3, paper="ssim", more_is_better=True)
_PERCEPTUAL_HELD_OUT = Column("perceptual", "perceptual held out", read_metric("interpolation/perceptual"), 3)
_LPIPS_HELD_OUT = tuple(
    Column(name, f"{label} held out", read_metric(f"interpolation/{name}"), 3) for name, label in LPIPS_NAMES
)
_HELD_OUT = (
    Column("psnr", "PSNR held out, dB", read_metric("interpolation/psnr"), 2, more_is_better=True),
    Column("ssim", "SSIM held out", read_metric("interpolation/ssim"), 3, more_is_better=True),
    _PERCEPTUAL_HELD_OUT,
    *_LPIPS_HELD_OUT,
)
_GAUSSIANS = Column("gaussians", "Gaussians", lambda cell: cell.gaussians, 0)
_SECONDS = Column("seconds", "seconds", sum_seconds(ALL_PHASES), 1)
_PREPARATION_S = Column("preparation_s", "ingest and plan, s", sum_seconds(PREPARATION), 1)
_CPU_SECONDS = Column("cpu_seconds", "CPU seconds", sum_cpu_seconds(ALL_PHASES), 1)
_MINUTES = Column("minutes", "minutes", sum_minutes(ALL_PHASES), 2, paper="minutes")

_COMPARISON = Layout(
    number=1,
    rows=(
        _row("3dgs", "3DGS"),
        _row("streetgs", "StreetGS"),
        _row("splatad", "SplatAD"),
        _row("g3r", "G3R"),
        _row("gnet", "Ours (GNet)"),
        _row("streetcrafter", "StreetCrafter"),
        _row("difix", "Difix3D"),
        _row("genre+", "Ours (GenRe+)"),
    ),
    columns=(_PSNR, _SSIM, *kernel_columns((1, 2, 3, 4, 5)), _MINUTES),
    extra_columns=(
        _PERCEPTUAL_HELD_OUT,
        *_LPIPS_HELD_OUT,
        *truth_columns((1, 3, 5)),
        _CPU_SECONDS,
        _GAUSSIANS,
    ),
    notes=(
        "Minutes are the wall time of initial scene and GNet's stage, and where there are any of novel views, fixer "
        "and distillation, as each was measured when it was computed; ingest and plan of effects are not in them.",
    ),
)
_PLUG_IN = Layout(
    number=2,
    rows=(
        _row("3dgs", "3DGS"),
        _row("3dgs+genre", "3DGS + GenRe"),
        _row("g3r", "G3R"),
        _row("g3r+genre", "G3R + GenRe (zero-shot)"),
        _row("g3r+genre-tuned", "G3R + GenRe (fine-tune)"),
    ),
    columns=kernel_columns((0, 1, 2, 3)),
    extra_columns=(*_HELD_OUT, *truth_columns((1, 3)), _SECONDS),
    notes=("At 0 m the set is that of the held-out frames.",),
)
_SCENE_PLUG_IN = replace(
    _PLUG_IN,
    rows=(_row("scene", "3DGS"), _row("scene+genre", "3DGS + GenRe"), _row("scene+difix")),
    notes=(
        *_PLUG_IN.notes,
        "The paper's numbers beside are those of its own 3DGS scenes, without and with GenRe. Held-out frames are kept "
        "from the enhancement alone: the scene may have been made from them.",
    ),
)
_FIXERS = Layout(
    number=3,
    rows=(
        _row("fixer-streetcrafter", "StreetCrafter (V)"),
        _row("fixer-difix", "Difix3D (Fixer)"),
        _row("fnet", "Ours (FNet)"),
    ),
    columns=(
        *kernel_columns((1, 2, 3)),
        Column("s_per_frame", "s/frame", seconds_per_fixed_view, 3, paper="s_per_frame"),
    ),
    extra_columns=(
        *(
            Column(f"render_kernel_{n}m", f"kernel of the renders @{n}m", read_metric(f"shift_{n}m/render_kernel"), 3)
            for n in (1, 2, 3)
        ),
        *truth_columns((1, 2, 3)),
    ),
    ends=("fnet",),
    # The paper's table 3 evaluates the fixer at these shifts, so it has to fix there and not at 3 m alone.
    protocol=(*PROTOCOL, "novel_views.shifts_m=[1.0,-1.0,2.0,-2.0,3.0,-3.0]"),
    notes=(
        "Each fixer gets GNet's renders of the source frames, moved by 1, 2 and 3 m to both sides; its images "
        "are compared as a set with all real images of the chunk. Seconds a frame are the stage's, loading the "
        "network and encoding references in them, over its images.",
    ),
)
_ABLATION = Layout(
    number=4,
    rows=(
        _row("gnet", "GNet"),
        _row("gnet-gnet", "GNet → FNet → GNet"),
        _row("gnet-enet", "GNet → FNet → ENet"),
    ),
    columns=kernel_columns((1, 2, 3, 4, 5)),
    extra_columns=(*_HELD_OUT, *truth_columns((1, 3, 5)), _SECONDS),
)
_RUNTIME = Layout(
    number=5,
    rows=(_row("difix", "Difix3D"), _row("genre+", "GenRe+")),
    columns=(
        Column("reconstruction", "reconstruction", sum_minutes(RECONSTRUCTION), 3, paper="reconstruction"),
        Column("fixer", "neural fixer", sum_minutes(FIXER), 3, paper="fixer"),
        Column("distillation", "distillation", sum_minutes(DISTILLATION), 3, paper="distillation"),
        Column("total", "total", sum_minutes(ALL_PHASES), 3, paper="total"),
    ),
    extra_columns=(_PREPARATION_S, _CPU_SECONDS, _GAUSSIANS),
    evaluated=False,
    notes=(
        "Minutes of wall time. Reconstruction: initial scene and GNet's stage; fixer: rendering the novel "
        "views and fixing them; distillation: ENet's stage. Ingest and plan of effects are not in the total.",
    ),
)
_RE_SIMULATION = Layout(
    number=6,
    rows=(_row("3dgs", "3DGS"), _row("difix", "Difix3D"), _row("genre+", "GenRe+")),
    columns=behaviour_columns(),
    extra_columns=(*behaviour_truth_columns(), replace(_GAUSSIANS, label="Gaussians of all chunks")),
    protocol=SIMULATION_PROTOCOL,
    evaluated=False,
    rollouts=TABLE_ROLLOUTS,
    notes=(
        "All chunks of a log make one recorded path. Each behaviour branches from it, 3 m to the left of its start "
        "and 3 m to the right; a number is the mean of both sides. A behaviour is as strong as a vehicle can drive it "
        "on this log without meeting a road user (1, 0.75, 0.5 or 0.25), in the place of the paper's vetting by hand. "
        "Where every strength meets one, it starts nearer to the recorded path, by half a metre at a time. Nearer "
        "starts and road users that no start avoids are named below.",
        "All cameras are rendered with a global shutter, and their images are compared as a set with all real images "
        "of the log's chunks. Where a truth is known, 12 images of each rollout are compared with it, spread over "
        "poses and cameras.",
    ),
)
_DOMAIN_GAP = Layout(
    number=7,
    rows=(_row("3dgs", "3DGS"), _row("difix", "Difix3D"), _row("genre+", "GenRe+")),
    columns=(*agreement_columns("box"), *agreement_columns("mask")),
    extra_columns=agreement_count_columns(),
    evaluated=False,
    across_cameras=True,
    notes=(
        "Each scene is reconstructed from the front camera alone, and rendered as the front-left camera recorded it. "
        "A detector's finds of road users on the recorded images are taken for the truth. AP and recall are at an "
        "overlap of 0.5, averaged over instances. IoU is that of instances that were found, as in the paper.",
    ),
)
LAYOUTS: Mapping[int, Layout] = {
    x.number: x for x in (_COMPARISON, _PLUG_IN, _FIXERS, _ABLATION, _RUNTIME, _RE_SIMULATION, _DOMAIN_GAP)
}
"""The tables by their numbers in the paper."""
SCENE_LAYOUTS: Mapping[int, Layout] = {_SCENE_PLUG_IN.number: _SCENE_PLUG_IN}
"""The tables that a scene of another program can be measured for."""
