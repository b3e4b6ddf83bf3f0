"""The one family of errors: each knows log, chunk, camera and frame, and says the remedy.

``TransientIOError`` (with backoff) and ``ResourceError`` (retried smaller) are the only ones a flow retries.
"""

from __future__ import annotations

from pathlib import Path


class GenreError(Exception):
    """Base of every error a user may meet.

    Args:
        problem: what is wrong, one sentence without a full stop.
        remedy: what the user can do about it.
        file, log, chunk, camera, frame, stage: where it happened; ``None`` where it does not apply.
    """

    def __init__(
        self,
        problem: str,
        *,
        remedy: str,
        file: str | Path | None = None,
        log: str | None = None,
        chunk: int | None = None,
        camera: str | None = None,
        frame: int | None = None,
        stage: str | None = None,
    ) -> None:
        super().__init__(problem)
        self.problem = problem
        self.remedy = remedy
        self.file = None if file is None else str(file)
        self.log = log
        self.chunk = chunk
        self.camera = camera
        self.frame = frame
        self.stage = stage

    @property
    def where(self) -> str:
        """The known coordinates, as ``log X, chunk 0, camera C, frame 3, file F``."""
        names = ("log", "chunk", "stage", "camera", "frame", "file")
        return ", ".join(f"{n} {getattr(self, n)}" for n in names if getattr(self, n) is not None)

    def __str__(self) -> str:
        where = f" ({self.where})" if self.where else ""
        return f"{self.problem}{where}. {self.remedy}"


class InputError(GenreError):
    """The log, or a file the user named, is missing, unreadable or unfit."""


class ConfigError(GenreError):
    """A configuration key or value is unknown or out of range."""


class NonFiniteError(GenreError):
    """A tensor that must be finite is not.

    Attributes: ``tensor`` (its name), ``count`` (non-finite entries), ``first_index`` (of the first one).
    """

    def __init__(self, stage: str, tensor: str, count: int, first_index: tuple[int, ...], **where: object) -> None:
        super().__init__(
            f"{tensor} holds {count} non-finite values, the first at index {first_index}",
            remedy="Run with --debug, and report the log and the seed if the input is sound.",
            stage=stage,
            **where,  # type: ignore[arg-type]
        )
        self.tensor = tensor
        self.count = count
        self.first_index = first_index


class ArtifactCorruptError(GenreError):
    """A stored file does not match its manifest (digest, size, schema)."""


class ResourceError(GenreError):
    """Memory, disk or a device does not suffice; retried smaller where a stage can split its work."""


class TransientIOError(GenreError):
    """A read or write failed in a way that may pass (network store, busy file system); retried with backoff."""
