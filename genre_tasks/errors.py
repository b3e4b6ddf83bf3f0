"""The one family of errors: each knows log, chunk, camera and frame, and says the remedy.

A flow retries only two of them: ``TransientIOError`` after a pause, and ``ResourceError`` with less work at once.
"""

from __future__ import annotations

from pathlib import Path


class GenreError(Exception):
    """Base of every error that a user may meet.

    Args:
        problem: what is wrong, one sentence without a full stop.
        remedy: what the user can do about it.
        file: the file that it happened with; ``None``, like the others, where it does not apply.
        log: the log that was processed.
        chunk: the chunk of it.
        camera: the camera.
        frame: the log's frame.
        stage: the stage that ran.

    Attributes are the arguments; ``file`` is a string.

    >>> print(InputError("no such file", remedy="Check the path.", log="001", frame=3))
    no such file (log 001, frame 3). Check the path.
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
        # A string, so that an error can be stored and compared.
        self.file = None if file is None else str(file)
        self.log = log
        self.chunk = chunk
        self.camera = camera
        self.frame = frame
        self.stage = stage

    @property
    def where(self) -> str:
        """What is known of the place, as ``log X, chunk 0, camera C, frame 3, file F``."""
        # From the whole to the part, as a user looks for it.
        names = ("log", "chunk", "stage", "camera", "frame", "file")
        return ", ".join(f"{name} {getattr(self, name)}" for name in names if getattr(self, name) is not None)

    def __str__(self) -> str:
        # Problem, place, remedy: what a user asks in this order.
        where = f" ({self.where})" if self.where else ""
        return f"{self.problem}{where}. {self.remedy}"


class InputError(GenreError):
    """The log, or a file that the user named, is missing, unreadable or unfit."""


class ConfigError(GenreError):
    """A configuration key or value is unknown or out of range."""


class NonFiniteError(GenreError):
    """A tensor that must be finite is not.

    Args:
        stage: the stage that computed it.
        tensor: its name.
        count: number of entries that are NaN or infinite.
        first_index: index of the first of them.
        where: log, chunk, camera or frame, as :class:`GenreError` takes them.
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
    """A stored file does not match its manifest: its digest, its size or its schema."""


class ResourceError(GenreError):
    """Memory, disk or a device does not suffice; retried with less at once where a stage can split its work."""


class DiskFullError(ResourceError):
    """A disk is full, or a quota or a limit of file sizes is reached; not retried, as a retry fills it once more."""


class UnsupportedMachineError(ResourceError):
    """The machine lacks a part, such as a compiled kernel, a package or a GPU; not retried, as it still would."""


class TransientIOError(GenreError):
    """A read or write failed in a way that may pass, such as a busy network store; retried after a pause."""
