"""``genre check``: what a log has and lacks, before hours are spent."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import typer

from flows.cli.options import JsonOption, LogArgument

if TYPE_CHECKING:
    from genre_tasks.log_checks.results import CameraCheck, LogCheck
    from genre_tasks.logs.findings import Finding


def check(log: LogArgument, as_json: JsonOption = False) -> None:
    """Check what a log has and lacks before it is reconstructed.

    Every image and every sweep is read. The command prints cameras, missing and unreadable images and sweeps, tracks,
    times, the distance travelled and the chunks, then what to do about each finding. It writes no files.

    The verdict is good, usable (with warnings) or unusable. The exit status is 1 for an unusable log.

    Example:

    \b
        genre check pandaset:data/002
    """
    from flows.cli.outcome import add_facts, print_outcome
    from genre_tasks.log_checks.check_log import check_log
    from genre_tasks.logs.registry import open_log

    add_facts(uri=log, verdict=None)
    report = check_log(open_log(log))
    # With the exit status a script can check a whole dataset before it spends hours on it.
    exit_code = 1 if report.verdict == "unusable" else 0
    if as_json:
        print_outcome("done", {"verdict": report.verdict} | dataclasses.asdict(report), exit_code=exit_code)
    else:
        _print_report(log, report)
    raise typer.Exit(exit_code)


def _print_report(log: str, report: LogCheck) -> None:
    from flows.cli.printing import print_fields

    fields = {name: value for name, value in dataclasses.asdict(report).items() if name not in ("uri", "cameras")}
    cameras = {camera.name: _describe_camera(camera) for camera in report.cameras}
    findings = "\n".join(_describe_finding(finding) for finding in report.findings)
    print_fields(log, {"verdict": report.verdict, "cameras": cameras} | fields | {"findings": findings})


def _describe_camera(camera: CameraCheck) -> str:
    # Counts alone: the findings below the table name the frames.
    problems = {
        "missing": camera.missing,
        "unreadable": camera.unreadable,
        "odd_size": camera.odd_size,
        "blank": camera.blank,
    }
    counts = [f", {len(frames)} {problem}" for problem, frames in problems.items() if frames]
    return f"{camera.width_px}×{camera.height_px}" + "".join(counts)


def _describe_finding(finding: Finding) -> str:
    text = f"{finding.severity} [{finding.word}]: {finding.message}"
    return f"{text}. {finding.remedy}" if finding.remedy else text
