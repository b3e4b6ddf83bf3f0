"""What ``genre bench`` writes, checked: a claim is a measured number beside its target, and it can fail."""

from __future__ import annotations

import json
import operator
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue, model_validator

Op = Literal[">=", ">", "<=", "<"]
_COMPARE: dict[str, Callable[[float, float], bool]] = {
    ">=": operator.ge,
    ">": operator.gt,
    "<=": operator.le,
    "<": operator.lt,
}


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Claim(_Strict):
    """One requirement: ``holds`` says whether ``measured op target``; a claim that was not measured does not hold."""

    id: str = Field(pattern=r"^[a-z0-9_]+(\.[a-z0-9_]+)+$")
    measured: float | None = Field(description="A median where n > 1; null: not measured, its row says why.")
    op: Op
    target: float
    unit: str = Field(min_length=1)
    n: int = Field(ge=0, description="Measurements behind the number.")
    spread: tuple[float, float] | None = Field(description="First and third quartile of the n measurements.")
    data: str = Field(min_length=1, description="What it was measured on.")
    holds: bool

    @model_validator(mode="after")
    def _is_what_the_number_says(self) -> Claim:
        if self.holds != _holds(self.measured, self.op, self.target):
            raise ValueError(f"{self.id}: holds is {self.holds}, but {self.measured} {self.op} {self.target} is not so")
        if self.measured is None and (self.n or self.spread):
            raise ValueError(f"{self.id}: not measured, and yet n = {self.n}, spread = {self.spread}")
        return self


class Result(_Strict):
    """A benchmark's file."""

    machine: str = Field(min_length=1, description="CPU model, cores, instruction set, torch version.")
    commit: str = Field(pattern=r"^([0-9a-f]{40}(\+changes)?|unknown)$")
    rows: list[dict[str, JsonValue]]
    claims: list[Claim]


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
    """A claim with ``holds`` worked out; ``measured`` ``None`` where nothing was measured."""
    if measured is None:
        n, spread = 0, None
    quartiles = None if spread is None else (spread[0], spread[1])
    holds = _holds(measured, op, target)
    return Claim(
        id=name, measured=measured, op=op, target=target, unit=unit, n=n, spread=quartiles, data=data, holds=holds
    )


def _holds(measured: float | None, op: str, target: float) -> bool:
    return measured is not None and bool(_COMPARE[op](measured, target))


def write_json(path: Path, value: Any) -> None:
    """JSON that appears whole or not at all, also when two processes write it. Raises ``ValueError`` for NaN."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    part.write_text(json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
    part.replace(path)
