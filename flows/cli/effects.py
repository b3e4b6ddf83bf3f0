"""``genre effects``: which effects a log calls for, and why."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.options import ChunkOption, LogArgument, PresetOption, SettingsOption, StoreOption
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_PRESET, DEFAULT_STORE

if TYPE_CHECKING:
    from genre_tasks.effects.types import EffectsPlan


def effects(
    log: LogArgument,
    chunk: ChunkOption = 0,
    preset: PresetOption = DEFAULT_PRESET,
    settings: SettingsOption = None,
    store: StoreOption = DEFAULT_STORE,
    out: Annotated[
        Path | None,
        typer.Option(
            parser=parse_path,
            metavar="PATH",
            help="A folder for effects.parquet, effects.png and the plan's other files, over those of an earlier plan.",
        ),
    ] = None,
) -> None:
    """Show which effects a log calls for, and why.

    For each effect, such as exposure or rolling shutter, the command measures the log and compares the result
    with a threshold. It prints the decision, the reason and what the effect would cost. Thresholds hold at the
    preset's resolution. `--set effects.NAME=on` or off decides by hand.

    Example:

    \b
        genre effects pandaset:data/002 --chunk 1 --out effects
    """
    from flows.cli.output_paths import check_output_folder
    from flows.cli.printing import print_rows
    from flows.configuration import load_configuration
    from flows.pipeline.effects_plan import plan_effects
    from flows.pipeline.log_cache import cached_log
    from flows.pipeline.stage_runner import Job
    from flows.preflight.requirements import check_requirements
    from genre_tasks.logs.log_selection import choose_working_size, select_cameras

    if out is not None:
        check_output_folder(out, "--out", ("effects.parquet", "effects.png"))
    config = load_configuration(preset, settings=settings or [])
    check_requirements(log, store, [chunk], config, ("ingest", "effects"))
    # Both stages go through the store: a run with the same settings finds this plan there and takes it.
    plan = plan_effects(Job(log, chunk, store, config.model_dump(mode="json")))
    rows = [
        {"effect": d.name, "choice": d.choice, "set": d.setting, "because": d.reason, "cost": d.cost}
        for d in plan.decisions
    ]
    # Images of another shape than the configured one are used in their own.
    width_px, height_px = choose_working_size(config.ingest, select_cameras(config.ingest, cached_log(log)))
    print_rows(f"{log} chunk {chunk}, {width_px}×{height_px}", rows)
    if out is not None:
        files = _write_plan(plan, out, f"{log} chunk {chunk}")
        typer.echo(f"wrote {', '.join(files)}")


def _write_plan(plan: EffectsPlan, folder: Path, title: str) -> list[str]:
    """Writes the plan's files and its picture into the folder, over those of an earlier plan; their paths."""
    from flows.output_errors import name_output
    from flows.plots.effects_plot import plot_effects_plan
    from genre_tasks.temporary_names import temporary_folder
    from storage.codecs import get_codec
    from storage.codecs.png import write_png

    folder.mkdir(parents=True, exist_ok=True)
    written = []
    # Everything is written beside the old files first, so that an error leaves the old ones as they were.
    with name_output(folder), temporary_folder(folder) as temporary:
        get_codec("effects").write(temporary, plan)
        write_png(temporary / "effects.png", plot_effects_plan(plan, title))
        # An earlier plan may have had masks, points or poses that this one lacks. Anything else is the user's.
        if (folder / "effects.parquet").is_file():
            tables = ("points.parquet", "poses.parquet", "ego_points.parquet")
            for path in [*(folder / "own").glob("*.png"), *(folder / table for table in tables)]:
                path.unlink(missing_ok=True)
        for source in sorted(temporary.rglob("*")):
            if source.is_file():
                target = folder / source.relative_to(temporary)
                target.parent.mkdir(parents=True, exist_ok=True)
                source.replace(target)
                written.append(str(target))
    return written
