"""Says what a chunk's log lacks, in the few lines that a manifest keeps of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from genre_tasks.scene.chunk import LogIssue


def group_issues(issues: Iterable[LogIssue]) -> list[str]:
    """Writes one line for each kind of issue: the first detail, and how many more there are.

    Args:
        issues: of the chunk's log.

    Returns:
        The lines, in the order in which the kinds first appear.
    """
    details_by_kind: dict[str, list[str]] = {}
    for issue in issues:
        details_by_kind.setdefault(issue.kind.replace("_", " "), []).append(issue.detail)
    lines = []
    for kind, details in details_by_kind.items():
        more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
        lines.append(f"{kind}: {details[0]}{more}")
    return lines
