"""``genre figure``: what the paper's tables compare, as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.options import (
    LogArgument,
    MethodsOption,
    PresetOption,
    SettingsOption,
    StoreOption,
    WeightsOption,
)
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_STORE

if TYPE_CHECKING:
    from flows.paper_tables.comparison_strips import ComparisonStrip
    from flows.paper_tables.figure import Kind
    from flows.paper_tables.request import CheckedRequest
    from flows.pipeline.stage_runner import ArtifactRef, Job


FigureKindArgument = Annotated[
    str,
    typer.Argument(
        help="What to compare: recon for the methods of table 1, fixers for those of table 3, swerve for those of "
        "table 6 along a swerve, manipulation for one actor removed, inserted and moved, agreement for what a "
        "detector finds on those of table 7."
    ),
]
FigureChunkOption = Annotated[
    int | None,
    typer.Option(
        help="The number of the chunk in the log, from 0. If not given, chunk 0; a swerve goes through all chunks."
    ),
]
CameraOption = Annotated[
    str | None,
    typer.Option(
        help="The camera to show. If not given, the first front camera; manipulation shows every camera in which an "
        "edit shows."
    ),
]
FrameOption = Annotated[
    int | None,
    typer.Option(
        help="The frame of the log to show; recon and fixers take source frames. If not given, the middle one; "
        "manipulation takes the one that shows the actor best. A swerve has no single frame."
    ),
]
ActorOption = Annotated[
    str | None,
    typer.Option(
        help="The actor that manipulation edits: its readable name, its number or its track id. If not given, the one "
        "that is largest in an image."
    ),
]

FigureDetectorOption = Annotated[
    str | None,
    typer.Option(
        "--detector",
        help="For agreement, the detector: an ONNX or TFLite file, torchvision:NAME or detectron2:CONFIG.",
    ),
]

FigureFileOption = Annotated[
    Path,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="The PNG file to write, such as figure.png; an existing one is replaced.",
    ),
]

# Of the options that choose what of a log is shown, and of which methods.
_CHOICES: Mapping[str, Sequence[str]] = {
    "recon": ("--camera", "--frame", "--method"),
    "fixers": ("--camera", "--frame", "--method"),
    "swerve": ("--camera", "--method"),
    # It edits the scene of one method, GenRe+.
    "manipulation": ("--camera", "--frame", "--actor"),
    "agreement": ("--frame", "--method"),
}


def figure(
    kind: FigureKindArgument,
    log: LogArgument,
    out: FigureFileOption,
    preset: PresetOption = "small",
    chunk: FigureChunkOption = None,
    camera: CameraOption = None,
    frame: FrameOption = None,
    actor: ActorOption = None,
    settings: SettingsOption = None,
    methods: MethodsOption = None,
    weights: WeightsOption = None,
    detector: FigureDetectorOption = None,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Draw a figure that compares methods, or edits of a scene.

    recon and fixers have a row for each method and a column for each distance to the left of the path. swerve has
    columns along its path. Their last row is the truth, where the log can tell it. manipulation has a row for each
    camera and a column for each edit of GenRe+'s scene. agreement shows the front-left camera at several moments.

    Stages that are not in the store are computed.

    Example:

    \b
        genre figure recon 'synthetic:street?seed=1000' --out figure.png
    """
    from flows.cli.output_paths import check_output_file
    from flows.paper_tables.comparison_strips import draw_strips
    from flows.paper_tables.figure import TABLE, parse_kind
    from flows.paper_tables.request import TableRequest
    from genre_tasks.atomic_path import atomic_path
    from storage.codecs.png import write_png

    parsed_kind = parse_kind(kind)
    choice = _Choice(camera, frame, actor)
    _refuse_unused(parsed_kind, choice, methods)
    # Checked before any stage is computed, which may take minutes.
    check_output_file(out, "--out", (".png",))
    # Edits are shown at one moment, and reading more chunks for it would take minutes.
    default_chunks = None if parsed_kind == "swerve" else (0,)
    request = TableRequest(
        number=TABLE[parsed_kind],
        logs=(log,),
        preset=preset,
        store=store,
        chunks=default_chunks if chunk is None else (chunk,),
        settings=tuple(settings or ()),
        methods=tuple(str(file) for file in methods or ()),
        weights=tuple(weights or ()),
        detector=detector,
    )
    checked = request.check()
    strips = _make_strips(parsed_kind, checked, choice)
    shown = ", ".join(str(where.chunk) for where in checked.places)
    title = " ".join([f"{log} chunk {shown}, preset {preset}", *request.settings])
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(out) as part:
        write_png(part, draw_strips(strips, title))
    not_drawn = f"; not drawn: {', '.join(checked.missing)}" if checked.missing else ""
    typer.echo(f"wrote {out}: {', '.join(strip.label for strip in strips)}{not_drawn}")


@dataclass(frozen=True)
class _Choice:
    # What of a log a figure shows; None leaves it to the figure.
    camera: str | None
    frame: int | None
    actor: str | None


def _refuse_unused(kind: Kind, choice: _Choice, methods: Sequence[Path] | None) -> None:
    from genre_tasks.errors import ConfigError

    options = {"--camera": choice.camera, "--frame": choice.frame, "--actor": choice.actor, "--method": methods or None}
    for option, value in options.items():
        # Without an effect it would be taken for one that has one.
        if value is not None and option not in _CHOICES[kind]:
            kinds = ", ".join(name for name, taken in _CHOICES.items() if option in taken)
            remedy = f"Leave it out; it belongs to {kinds}."
            raise ConfigError(f"the figure {kind} has no use for {option}", remedy=remedy)


def _make_strips(kind: Kind, checked: CheckedRequest, choice: _Choice) -> list[ComparisonStrip]:
    from flows.cli.terminal import TerminalReporter
    from flows.paper_tables.figure import comparison_strips
    from flows.paper_tables.rollout_figures import manipulation_strips, swerve_strips
    from flows.pipeline.stage_runner import run_stage

    # Without Prefect: one log needs neither its retries nor its server, which takes seconds to start.
    reporter = TerminalReporter(f"figure {kind}")

    def run_reported(stage: str, job: Job, inputs: dict[str, ArtifactRef]) -> ArtifactRef:
        reporter.part_started(stage)
        ref = run_stage(stage, job, inputs, progress=reporter.progress)
        reporter.part_ended("cached" if ref.cached else "computed")
        return ref

    with reporter:
        if kind == "agreement":
            from flows.paper_tables.agreement_figure import agreement_strips

            return agreement_strips(checked, run_reported, choice.frame)
        if kind == "swerve":
            return swerve_strips(checked, run_reported, choice.camera)
        if kind == "manipulation":
            return manipulation_strips(checked, run_reported, choice.actor, choice.camera, choice.frame)
        return comparison_strips(kind, checked, run_reported, choice.camera, choice.frame)
