"""The check that a file's weights are those of a network, with one error that names everything that is not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from genre_tasks.errors import InputError

MAX_PROBLEMS = 5
"""So many problems are named; of weights of another network nearly every tensor is one."""


def require_weights_fit(
    found: Mapping[str, Tensor],
    expected: Mapping[str, Tensor],
    path: Path,
    remedy: str,
    stage: str | None = None,
    dtypes: Sequence[torch.dtype] = (),
) -> None:
    """Refuses weights that a network cannot use.

    Args:
        found: the tensors of the file, by name.
        expected: the network's, by name.
        path: of the file, for the error.
        remedy: what the user can do.
        stage: the stage that loads them, for the error.
        dtypes: dtypes that any tensor may have; by default its own in the network.

    Raises:
        InputError: a tensor is missing or unknown, has another shape or dtype, or holds NaN or infinity.

    >>> weight = {"weight": torch.zeros(2, 3)}
    >>> require_weights_fit(weight, weight, Path("x.safetensors"), "Train it again.")
    >>> require_weights_fit({}, weight, Path("x.safetensors"), "Train it again.")
    Traceback (most recent call last):
    ...
    genre_tasks.errors.InputError: ...
    """
    problems = [f"missing {name}" for name in sorted(expected.keys() - found.keys())]
    problems += [f"unknown {name}" for name in sorted(found.keys() - expected.keys())]
    for name in sorted(found.keys() & expected.keys()):
        allowed = tuple(dtypes) or (expected[name].dtype,)
        if found[name].shape != expected[name].shape or found[name].dtype not in allowed:
            actual = _describe((found[name].dtype,), found[name].shape)
            problems.append(f"{name} is {actual} where {_describe(allowed, expected[name].shape)} is expected")
        elif not bool(torch.isfinite(found[name]).all()):
            problems.append(f"{name} holds non-finite values")
    if problems:
        more = f" and {len(problems) - MAX_PROBLEMS} more" if len(problems) > MAX_PROBLEMS else ""
        raise InputError(
            f"The weights do not fit the network: {'; '.join(problems[:MAX_PROBLEMS])}{more}",
            remedy=remedy,
            file=path,
            stage=stage,
        )


def _describe(dtypes: Sequence[torch.dtype], shape: torch.Size) -> str:
    names = " or ".join(str(dtype).removeprefix("torch.") for dtype in dtypes)
    return f"{names} {list(shape)}"
