"""What ``genre bench`` writes, checked: a claim is a measured number beside its target, and it can fail."""

from __future__ import annotations

import json
import operator
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue, model_validator

from genre_tasks.atomic_path import atomic_path

Op = Literal[">=", ">", "<=", "<"]
_COMPARE: dict[str, Callable[[float, float], bool]] = {
    ">=": operator.ge,
    ">": operator.gt,
    "<=": operator.le,
    "<": operator.lt,
}
# No string of JSON holds a line break, so these brackets and commas are those of a list.
_PLAIN_LIST = re.compile(r"\[\n\s*([^\[\]{}]*?)\n\s*\]")
_NEXT_LINE = re.compile(r",\n\s*")


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Claim(_Strict):
    """One requirement: ``holds`` says whether ``measured op target``; a claim that was not measured does not hold."""

    id: str = Field(pattern=r"^[a-z0-9_]+(\.[a-z0-9_]+)+$", description="Benchmark and name, joined by a dot.")
    measured: float | None = Field(
        description="One measurement, or the median, mean, share, sum or worst of n; null: not measured."
    )
    op: Op = Field(description="How the number has to compare with the target.")
    target: float = Field(description="In the unit of the number.")
    unit: str = Field(min_length=1, description="Such as dB, s or ratio.")
    n: int = Field(ge=0, description="Measurements behind the number.")
    spread: tuple[float, float] | None = Field(
        description="First and third quartile of the n measurements, or the 95 % interval where the data names one."
    )
    data: str = Field(min_length=1, description="What it was measured on.")
    holds: bool = Field(description="Whether the number meets the target.")

    @model_validator(mode="after")
    def _is_what_the_number_says(self) -> Claim:
        # Checked on reading too, so that no edited file can claim what its own number denies.
        if self.holds != _holds(self.measured, self.op, self.target):
            raise ValueError(f"{self.id}: holds is {self.holds}, but {self.measured} {self.op} {self.target} is not so")
        if self.measured is None and (self.n or self.spread):
            raise ValueError(f"{self.id}: not measured, and yet n = {self.n}, spread = {self.spread}")
        return self


class Result(_Strict):
    """A benchmark's file."""

    machine: str = Field(min_length=1, description="CPU model, cores, instruction set, torch version.")
    commit: str = Field(pattern=r"^([0-9a-f]{40}(\+changes)?|unknown)$", description="Of the checkout.")
    options: dict[str, str] = Field(
        default_factory=dict,
        description="Those that differ from the benchmark's defaults; files of earlier versions note none.",
    )
    rows: list[dict[str, JsonValue]] = Field(description="What each cell measured, with its name as `cell`.")
    claims: list[Claim] = Field(description="Made of the rows.")


def claim(
    name: str,
    measured: float | None,
    op: Op,
    target: float,
    unit: str,
    data: str,
    n: int = 1,
    spread: Sequence[float] | None = None,
) -> Claim:
    """Makes a claim with ``holds`` worked out.

    Args:
        name: its id, such as ``raster.build_s``.
        measured: the number; ``None`` where nothing was measured.
        op: how the number has to compare with the target.
        target: in the unit of the number.
        unit: such as ``dB``, ``s`` or ``ratio``.
        data: what it was measured on.
        n: number of measurements behind the number.
        spread: first and third quartile of the measurements, or a 95 % interval that the data names.

    Returns:
        The claim; without a number its ``n`` is 0 and it has no spread.

    >>> claim("raster.build_s", 7.5, "<=", 10.0, "s", "an empty folder").holds
    True
    """
    # The caller's count is of what it wanted to measure.
    if measured is None:
        n = 0
        spread = None
    return Claim(
        id=name,
        measured=measured,
        op=op,
        target=target,
        unit=unit,
        n=n,
        spread=None if spread is None else (spread[0], spread[1]),
        data=data,
        holds=_holds(measured, op, target),
    )


def _holds(measured: float | None, op: str, target: float) -> bool:
    # What was not measured fails, so that leaving out a cell never makes a claim hold.
    return measured is not None and bool(_COMPARE[op](measured, target))


def write_json(path: Path, value: Any) -> None:
    """Writes JSON that appears whole or not at all, also when two processes write it.

    A list of numbers or words stands in one line, since curves of a thousand points would be a thousand lines.

    Args:
        path: the file to write or replace; its folder is made if need be.
        value: JSON values.

    Raises:
        ValueError: a number is NaN or infinite, which JSON does not have.
    """
    # NaN is no JSON, and other readers would fail on the file much later.
    text = json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False)
    short = _PLAIN_LIST.sub(lambda found: f"[{_NEXT_LINE.sub(', ', found[1])}]", text)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        part.write_text(short + "\n", encoding="utf-8")
