"""``genre effects``: which effects a log calls for, and why."""

from __future__ import annotations

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer


def effects(
    log: Annotated[str, typer.Argument(help="pandaset:PATH/002 or synthetic:street?seed=1000")],
    chunk: Annotated[int, typer.Option(help="A chunk of the log.")] = 0,
    preset: Annotated[
        str, typer.Option(help="demo, small, fine, long or paper: thresholds hold at its resolution.")
    ] = "small",
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="effects.NAME=on|off|auto, or any other setting.")
    ] = None,
    store: Annotated[str, typer.Option(help="Where the ingested chunk is kept.")] = "genre-store",
    out: Annotated[Path | None, typer.Option(help="A folder for effects.parquet and effects.png.")] = None,
) -> None:
    """Say for each effect what of the log decides, its threshold, the decision and what enabling would cost."""
    from flows.cli.printing import print_rows
    from flows.configuration import load_configuration
    from flows.pipeline.effects_plan import effects_of
    from flows.pipeline.stage_runner import Job
    from flows.plots.effects_plot import drawn
    from storage.codecs import codec_of
    from storage.codecs.png import write_png

    config = load_configuration(preset, settings=settings or [])
    found = effects_of(Job(log, chunk, store, config.model_dump(mode="json")))
    rows = [
        {"effect": d.name, "choice": d.choice, "set": d.setting, "because": d.reason, "cost": d.cost}
        for d in found.decisions
    ]
    print_rows(f"{log} chunk {chunk}, {config.ingest.width_px}×{config.ingest.height_px}", rows)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=out) as made:  # written once there, as in the store, then put in place
            codec_of("effects").write(Path(made), found)
            write_png(Path(made) / "effects.png", drawn(found, f"{log} chunk {chunk}"))
            shutil.rmtree(out / "own", ignore_errors=True)  # masks of a plan that was here before
            for path in sorted(Path(made).rglob("*")):
                if path.is_file():
                    place = out / path.relative_to(made)
                    place.parent.mkdir(parents=True, exist_ok=True)
                    path.replace(place)
        typer.echo(f"wrote {out / 'effects.parquet'} and effects.png")
