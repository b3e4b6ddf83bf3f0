"""``genre range``: how far beside the path a finished run's scene can be trusted."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer


def reliable(
    run: Annotated[str, typer.Argument(help="A run's name (or its start), as `genre show runs` lists it.")],
    stage: Annotated[str | None, typer.Option(help="initial, gnet or enet; the run's last without it.")] = None,
    chunk: Annotated[int | None, typer.Option(help="A chunk of the run; the first one without it.")] = None,
    max_drop_db: Annotated[float, typer.Option(help="How much the median view's estimated PSNR may fall, dB.")] = 3.0,
    every: Annotated[int, typer.Option(help="Every n-th frame is rendered.")] = 4,
    store: Annotated[str, typer.Option(help="The run's store.")] = "genre-store",
    detector: Annotated[
        Path | None,
        typer.Option(help="A detector as ONNX (FastestDet's form): how many actors it finds is a guard too."),
    ] = None,
    out: Annotated[Path, typer.Option(help="A folder for range.parquet and range.png.")] = Path("range"),
) -> None:
    """Say how far to the left and right of the path the scene's renders agree with what was recorded.

    Guards need no truth: the agreement with recorded images, what none of them shows, holes, what floats, and what a
    detector does not find any more. Where the run has the next chunk too, the same view is rendered from both.
    """
    from pydantic import ValidationError

    from flows.cli.printing import print_rows
    from flows.cli.terminal import TerminalReporter
    from flows.reconstruction.reliable_range import write
    from flows.reconstruction.run_records import last_stage, next_scene, stage_scene, stage_value
    from genre_tasks.config import RangeConfig
    from genre_tasks.errors import ConfigError
    from genre_tasks.reliability.chunk_seam import medians, seam
    from genre_tasks.reliability.reliable_range import reliable_range

    try:
        config = RangeConfig(max_drop_db=max_drop_db, every=every)
    except ValidationError as error:
        raise ConfigError(f"{error.errors()[0]['msg']}", remedy="See `genre range --help`.") from error
    network = None
    if detector is not None:
        from genre_tasks.reliability.detector import Detector

        network = Detector.load(detector)
    number, ingested = stage_value(store, run, chunk, "ingest")
    name = stage or last_stage(store, run, number)
    _, plan = stage_value(store, run, number, "effects")
    scene = stage_scene(store, run, number, name)
    with TerminalReporter(f"chunk {number}  guards") as reporter:
        found = reliable_range(config, ingested, scene, plan, reporter.progress, network)
    beside = next_scene(store, run, number, stage)
    facts = {"log": ingested.log, "chunk": str(number), "stage": name, "run": run}
    files = write(out, found, facts)
    rows = [
        {
            "shift": f"{p.shift_m:+g} m",
            "views": p.views,
            "estimate": f"{p.estimate_db:.1f} dB",
            "agreement": f"{p.agreement_db:.1f} dB",
            "shown": f"{p.shown:.1%}",
            "thin": f"{p.thin:.1%}",
            "floating": f"{p.floating:.1%}",
            "detected": "" if math.isnan(p.detected) else f"{p.detected:.0%}",
            "": "holds" if p.holds else "",
        }
        for p in found.points
    ]
    print_rows(f"{ingested.log}, chunk {number}, after {name}", rows)
    typer.echo(f"{found}; wrote {', '.join(files)}")
    if beside is not None:
        jumps = medians(seam((ingested, scene), beside))
        told = ", ".join(f"{db:.1f} dB at {distance:g} m" for distance, db in jumps.items())
        typer.echo(f"seam to chunk {number + 1}, the same view from both scenes without actors: {told}")
