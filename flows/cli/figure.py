"""``genre figure``: what the paper's tables compare, as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from flows.pipeline.stage_runner import ArtifactRef, Job


def figure(
    kind: Annotated[str, typer.Argument(help="recon: table 1's methods; fixers: table 3's.")],
    log: Annotated[str, typer.Argument(help="A log: pandaset:PATH/002, synthetic:street?seed=…")],
    out: Annotated[Path, typer.Option(help="x.png")],
    preset: Annotated[str, typer.Option(help="demo, small, fine, long or paper.")] = "small",
    chunk: Annotated[int, typer.Option(help="Of the log.")] = 0,
    camera: Annotated[str | None, typer.Option(help="A camera; the first front one without it.")] = None,
    frame: Annotated[int | None, typer.Option(help="A source frame; the middle one without it.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="section.key=value over the preset, for every method.")
    ] = None,
    methods: Annotated[
        list[Path] | None, typer.Option("--method", help="A YAML file of a method of your own, see `genre table`.")
    ] = None,
    weights: Annotated[list[str] | None, typer.Option(help="NAME=PATH of weights, see `genre table`.")] = None,
    store: Annotated[str, typer.Option(help="Where stages are kept and found again.")] = "genre-store",
) -> None:
    """Draw a row for each method and a column for each shift to the left, with the truth where the log can tell it.

    Stages that the store has not are computed.
    """
    from flows.cli.terminal import TerminalReporter
    from flows.paper_tables.figure import TABLE, drawn, kind_of, strips
    from flows.paper_tables.request import Request
    from flows.pipeline.stage_runner import produce
    from genre_tasks.atomic_path import atomic_path
    from genre_tasks.errors import ConfigError
    from storage.codecs.png import write_png

    chosen = kind_of(kind)
    if out.suffix != ".png":
        raise ConfigError(f"cannot write {out.name!r}", remedy="Give --out x.png.")
    own = tuple(str(f) for f in methods or ())
    request = Request(TABLE[chosen], (log,), preset, store, (chunk,), tuple(settings or ()), own, tuple(weights or ()))
    plan = request.planned()
    reporter = TerminalReporter(f"figure {chosen}")

    def produced(stage: str, job: Job, inputs: dict[str, ArtifactRef]) -> ArtifactRef:
        reporter.began(stage)
        ref = produce(stage, job, inputs, progress=reporter.progress)
        reporter.ended("cached" if ref.cached else "computed")
        return ref

    with reporter:
        found = strips(chosen, plan, produced, camera, frame)
    said = " ".join([f"{log} chunk {chunk}, preset {preset}", *request.settings])
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(out) as part:
        write_png(part, drawn(chosen, found, said))
    left = f"; not drawn: {', '.join(plan.missing)}" if plan.missing else ""
    typer.echo(f"wrote {out}: {', '.join(s.label for s in found)}{left}")
