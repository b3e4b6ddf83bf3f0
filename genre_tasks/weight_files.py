"""Headers of safetensors files: which tensors there are and of what shape, without reading them and without torch."""

from __future__ import annotations

from pathlib import Path

from genre_tasks.errors import InputError


def read_tensor_shapes(path: Path, remedy: str, stage: str | None = None) -> dict[str, tuple[int, ...]]:
    """Reads the header of a safetensors file; its length is checked against the file's.

    Args:
        path: of the file.
        remedy: what the user can do, for errors.
        stage: the stage that loads the file, for errors.

    Returns:
        The shape of each tensor, by name.

    Raises:
        InputError: the file is missing, incomplete or no safetensors.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            return {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise InputError(f"the weights cannot be read: {error}", remedy=remedy, file=path, stage=stage) from error
