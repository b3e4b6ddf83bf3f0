"""What an export is asked for, and what it reports."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from genre_tasks.errors import ConfigError
from genre_tasks.progress import Progress

if TYPE_CHECKING:
    from flows.exchange.stored_scenes import StoredScenes


@dataclass(frozen=True)
class ExportRequest:
    """An export.

    Attributes:
        store: folder (or URI) of the store.
        scene: name of a run or of an imported scene, its key, or the start of one of them.
        format: name of a format.
        out: the folder to write.
        stage: initial, gnet or enet; ``None``: the last one of each chunk.
        chunks: numbers of the chunks; ``None``: all.
        frame: log frame to pose the scene at; ``None``: not posed.
        all_frames: whether the scene is posed at each of its frames.
        per_actor: whether the actors alone are written, each in its own coordinates.
        overwrite: whether an export that is at ``out`` may be replaced.

    Raises:
        ConfigError: more than one of ``frame``, ``all_frames`` and ``per_actor`` is there.
    """

    store: str
    scene: str
    format: str
    out: Path
    stage: str | None = None
    chunks: tuple[int, ...] | None = None
    frame: int | None = None
    all_frames: bool = False
    per_actor: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        options = {"--frame": self.frame is not None, "--all-frames": self.all_frames, "--per-actor": self.per_actor}
        chosen = [name for name, is_chosen in options.items() if is_chosen]
        if len(chosen) > 1:
            raise ConfigError(f"{' and '.join(chosen)} exclude each other", remedy="Give one of them.")


class SceneExporter(Protocol):
    """Writes the scenes of a run, or imported ones, into a folder in some format."""

    def check(self, request: ExportRequest) -> None:
        """Checks the request before any scene is read.

        Args:
            request: for this exporter's format.

        Raises:
            ConfigError: the format cannot do what is asked for.
        """
        ...

    def export(self, scenes: StoredScenes, request: ExportRequest, folder: Path, progress: Progress) -> dict[str, Any]:
        """Writes all files, ``scene.json`` among them.

        Args:
            scenes: read chunk by chunk.
            request: for this exporter's format.
            folder: an empty folder, which takes its place when all is written.
            progress: called after each file.

        Returns:
            JSON values for the report; ``losses``, sentences on what the files do not carry, is among them.

        Raises:
            InputError: a scene does not fit into the format.
            OSError: a file cannot be written.
        """
        ...
