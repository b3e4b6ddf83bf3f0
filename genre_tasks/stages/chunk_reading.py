"""What the steps of ``ingest`` share while they read one chunk of a log."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from genre_tasks.config import IngestConfig
from genre_tasks.errors import InputError
from genre_tasks.logs.types import DrivingLog, Float64
from genre_tasks.progress import Progress
from genre_tasks.scene.chunk import LogIssue


@dataclass(frozen=True)
class ChunkReading:
    """A chunk that is being read.

    Attributes:
        config: of the stage.
        log: that is read.
        chunk: index of the chunk.
        frames: log frames of the chunk, in order.
        world_SE3_chunk: [4, 4] the chunk's own coordinates.
        chunk_SE3_ego: [F, 4, 4] pose of the vehicle at each frame.
        progress: callback of the stage.
        log_issues: what was missing, unreadable or left out so far; it grows.
    """

    config: IngestConfig
    log: DrivingLog
    chunk: int
    frames: tuple[int, ...]
    world_SE3_chunk: Float64
    chunk_SE3_ego: Float64
    progress: Progress
    # The only thing that changes while a chunk is read, so that no step has to hand it on.
    log_issues: list[LogIssue] = field(default_factory=list)

    def report(self, done: int, note: str) -> None:
        """Reports progress.

        Args:
            done: steps done, of three for each frame: images, sweeps, colours.
            note: what is being done.
        """
        self.progress(done, 3 * len(self.frames), note)

    def add_issue(self, kind: str, detail: str, frame: int | None = None, camera: str | None = None) -> None:
        """Notes something that the log lacks or that was left out.

        Args:
            kind: what it is.
            detail: one clause for a reader.
            frame: log frame, where it is about one.
            camera: where it is about one.
        """
        self.log_issues.append(LogIssue(kind, detail, frame=frame, camera=camera))

    def input_error(self, problem: str, remedy: str, camera: str | None = None, frame: int | None = None) -> InputError:
        """Makes an error that names log and chunk.

        Args:
            problem: what is wrong.
            remedy: what the user can do.
            camera: where it is about one.
            frame: log frame, where it is about one.

        Returns:
            The error, to be raised.
        """
        return InputError(problem, remedy=remedy, log=self.log.name, chunk=self.chunk, camera=camera, frame=frame)

    def explain_long_path(self, error: InputError) -> InputError:
        """Adds to an error about the length of the path where that comes from.

        Args:
            error: of a step that lays a grid along the path.

        Returns:
            The error with log, chunk and the frame whose pose lies farthest from the middle, to be raised.
        """
        path = self.chunk_SE3_ego[:, :2, 3]
        # The median: a mean would follow a single wrong pose.
        distance_m = np.linalg.norm(path - np.median(path, axis=0), axis=1)
        farthest = int(distance_m.argmax())
        return self.input_error(
            f"{error.problem}, and this frame lies {distance_m[farthest]:.0f} m from its median position",
            "Correct the pose of this frame, leave the chunk out with --chunks, or set a smaller ingest.chunk_frames.",
            frame=self.frames[farthest],
        )
