"""``genre figure``: what the paper's tables compare, as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.options import (
    ChunkOption,
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
    from flows.pipeline.stage_runner import ArtifactRef, Job


CameraOption = Annotated[str | None, typer.Option(help="The camera to show. The first front camera if not given.")]
FrameOption = Annotated[
    int | None, typer.Option(help="The frame of the log to show, a source frame. The middle one if not given.")
]

FigureFileOption = Annotated[
    Path,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="The PNG file to write, such as figure.png; an existing one is replaced.",
    ),
]


def figure(
    kind: Annotated[
        str,
        typer.Argument(help="The methods to compare: recon for those of table 1, fixers for those of table 3."),
    ],
    log: LogArgument,
    out: FigureFileOption,
    preset: PresetOption = "small",
    chunk: ChunkOption = 0,
    camera: CameraOption = None,
    frame: FrameOption = None,
    settings: SettingsOption = None,
    methods: MethodsOption = None,
    weights: WeightsOption = None,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Draw a figure that compares methods beside the path.

    The figure has a row for each method and a column for each distance to the left of the path. The last row is the
    truth, where the log can tell it. Stages that are not in the store are computed.

    Example:

    \b
        genre figure recon 'synthetic:street?seed=1000' --out figure.png
    """
    from flows.cli.output_paths import check_output_file
    from flows.cli.terminal import TerminalReporter
    from flows.paper_tables.figure import TABLE, comparison_strips, draw_strips, parse_kind
    from flows.paper_tables.request import TableRequest
    from flows.pipeline.stage_runner import run_stage
    from genre_tasks.atomic_path import atomic_path
    from storage.codecs.png import write_png

    parsed_kind = parse_kind(kind)
    # Checked before any stage is computed, which may take minutes.
    check_output_file(out, "--out", (".png",))
    request = TableRequest(
        number=TABLE[parsed_kind],
        logs=(log,),
        preset=preset,
        store=store,
        chunks=(chunk,),
        settings=tuple(settings or ()),
        methods=tuple(str(file) for file in methods or ()),
        weights=tuple(weights or ()),
    )
    checked = request.check()
    # Without Prefect: one chunk needs neither its retries nor its server, which takes seconds to start.
    reporter = TerminalReporter(f"figure {parsed_kind}")

    def run_reported(stage: str, job: Job, inputs: dict[str, ArtifactRef]) -> ArtifactRef:
        reporter.part_started(stage)
        ref = run_stage(stage, job, inputs, progress=reporter.progress)
        reporter.part_ended("cached" if ref.cached else "computed")
        return ref

    with reporter:
        strips = comparison_strips(parsed_kind, checked, run_reported, camera, frame)
    title = " ".join([f"{log} chunk {chunk}, preset {preset}", *request.settings])
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(out) as part:
        write_png(part, draw_strips(parsed_kind, strips, title))
    not_drawn = f"; not drawn: {', '.join(checked.missing)}" if checked.missing else ""
    typer.echo(f"wrote {out}: {', '.join(strip.label for strip in strips)}{not_drawn}")
