"""How many Gaussians a reconstruction starts from, as far as configuration and files tell before any is made."""

from __future__ import annotations

from pathlib import Path

from genre_tasks.config import InitialConfig

_SPLAT_BYTES = 32
"""Of a Gaussian in a ``.splat`` file, which has no header."""


def count_start_gaussians(config: InitialConfig) -> int:
    """Counts the Gaussians of the initial scene before it is made.

    Args:
        config: the section of the initial scene.

    Returns:
        Those of the scene's file where it is a PLY or ``.splat`` file. Else the most that are placed on LiDAR points
        and far away, also for files of other formats: these do not tell without being read.

    Raises:
        InputError: the header of the PLY file is damaged, or claims more than the file holds.

    >>> count_start_gaussians(InitialConfig(max_points=1000, distant_count=100))
    1100
    """
    counted = None if config.scene is None else _count_in_file(Path(config.scene))
    return config.max_points + config.distant_count if counted is None else counted


def _count_in_file(file: Path) -> int | None:
    """The number of Gaussians; ``None`` where the file does not tell."""
    # A file that is gone is no error here: what was made of it may be in the store.
    if not file.is_file():
        return None
    suffix = file.suffix.lower()
    if suffix == ".splat":
        return file.stat().st_size // _SPLAT_BYTES
    if suffix != ".ply":
        return None
    # Here and not above: most runs start from LiDAR, and need no reader of PLY files.
    from genre_tasks.exchange.ply_header import read_ply_header

    table = read_ply_header(file).tables.get("vertex")
    return None if table is None else table.count
