"""``genre check``: what a log has and lacks, before hours are spent."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from genre_tasks.logs.validation import LogCheck


def check(
    log: Annotated[str, typer.Argument(help="pandaset:PATH/002 or synthetic:street?seed=1000")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object to stdout.")] = False,
) -> None:
    """Say what a log has and lacks: cameras, images, sweeps, tracks, times, travel, chunks. Exit code 1: unusable."""
    from genre_tasks.logs.registry import open_log
    from genre_tasks.logs.validation import check_log

    found = check_log(open_log(log))
    if as_json:
        typer.echo(json.dumps({"verdict": found.verdict} | dataclasses.asdict(found), default=str))
    else:
        _print(log, found)
    if found.verdict == "unusable":
        raise typer.Exit(1)


def _print(log: str, found: LogCheck) -> None:
    from flows.cli.printing import print_fields

    fields = {name: value for name, value in dataclasses.asdict(found).items() if name not in ("uri", "cameras")}
    cameras = {
        c.name: f"{c.width_px}×{c.height_px}"
        + "".join(f", {len(getattr(c, k))} {k}" for k in ("missing", "unreadable", "odd_size") if getattr(c, k))
        for c in found.cameras
    }
    findings = [f"{f.severity}: {f.message}{'. ' * bool(f.remedy)}{f.remedy}" for f in found.findings]
    print_fields(log, {"verdict": found.verdict, "cameras": cameras} | fields | {"findings": "\n".join(findings)})
