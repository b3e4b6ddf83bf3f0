"""Reads a layer with OpenUSD in a process of its own, and leaves plain arrays and JSON for the caller.

OpenUSD takes the memory that a file asks for: a few damaged bytes ask for terabytes, and the system then ends the
process. Run as ``python -P -m genre_tasks.exchange.usd.stage_dump LAYER FOLDER BYTES``, with a limit on its memory.
This module imports neither torch nor SciPy, so that it starts at once.
"""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Tf, Usd, UsdGeom, UsdUtils, UsdVol

from genre_tasks.errors import InputError
from genre_tasks.exchange.usd import names
from genre_tasks.exchange.usd.layer_checks import check_layers
from genre_tasks.exchange.usd.read_budget import ReadBudget

STAGE_FILE = "stage.json"
ARRAYS_FILE = "arrays.npz"

WIDTHS = {"positions": 3, "scales": 3, "orientations": 4, "opacities": 1, names.COEFFICIENTS: 3}
"""Attributes that are read, each of float or else of half precision, and the numbers of an entry."""

_MAX_FIELDS = 10_000
_MAX_POSES = 2_000_000
"""Fields times moments: a file may state a moment for one field that all others get a place for."""

_COLOR_SPACE_CHARACTERS = 100
"""One name may hold for all fields, and is written for each of them: a long one would take much memory."""

_BASE_BYTES = 1 << 30
_BYTES_PER_BYTE = 24
"""Text takes much more memory than its bytes while it is parsed."""


def limit_memory(file_bytes: int) -> None:
    """Limits what this process may take.

    Args:
        file_bytes: size of the file that is read.
    """
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    limit = _BASE_BYTES + _BYTES_PER_BYTE * file_bytes
    resource.setrlimit(resource.RLIMIT_DATA, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))


def dump_stage(layer: Path, folder: Path, file_bytes: int) -> None:
    """Writes what a scene needs of a stage.

    Args:
        layer: the layer that is shown.
        folder: gets ``stage.json`` and ``arrays.npz``.
        file_bytes: size of the file that is read.

    Raises:
        InputError: a layer names other files, there is no field of Gaussians, or the file asks for too much memory.
        pxr.Tf.ErrorException: the layer is damaged.
    """
    check_layers(layer)
    stage = Usd.Stage.Open(str(layer))
    losses: list[str] = []
    prims = list(_find_fields(stage, losses))
    root = stage.GetDefaultPrim()
    is_ours = bool(root) and root.GetCustomDataByKey(names.VERSION) is not None
    ours = _read_data(root, names.SCENE_ENTRIES) if is_ours else {}
    rate = float(stage.GetTimeCodesPerSecond())
    times_s = ours.get(names.TIMES_S)
    codes = [names.to_time_code(float(time), rate) for time in times_s] if times_s else _find_codes(prims)
    if len(prims) * len(codes) > _MAX_POSES:
        raise _damage(f"the file moves {len(prims)} nodes at {len(codes)} moments")
    budget = ReadBudget(file_bytes)
    arrays: dict[str, Any] = {}
    fields = [_dump_field(prim, codes, f"{k}/", arrays, budget, losses) for k, prim in enumerate(prims)]
    np.savez(folder / ARRAYS_FILE, **arrays)
    values = {
        "metres_per_unit": float(UsdGeom.GetStageMetersPerUnit(stage)),
        "up_axis": str(UsdGeom.GetStageUpAxis(stage)),
        "rate": rate,
        "codes": codes,
        "scene": ours,
        "fields": fields,
        "losses": losses,
    }
    (folder / STAGE_FILE).write_text(json.dumps(values), encoding="utf-8")


def _find_fields(stage: Any, losses: list[str]) -> Iterator[Any]:
    found = 0
    hidden = 0
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if not prim.HasAPI(UsdVol.ParticleFieldKernelGaussianEllipsoidAPI):
            continue
        if UsdGeom.Imageable(prim).ComputePurpose() in (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide):
            hidden += 1
            continue
        found += 1
        if found > _MAX_FIELDS:
            raise _damage(f"the file has more than {_MAX_FIELDS} fields of Gaussians")
        yield prim
    if hidden:
        losses.append(f"{hidden} fields of Gaussians are proxies or guides, which are not read.")
    if not found:
        raise InputError(
            "the file has no field of Gaussians", remedy="Give one with prims of the type ParticleField3DGaussianSplat."
        )


def _find_codes(prims: list[Any]) -> list[float]:
    """All time codes at which a field or something above it is placed, shown or hidden."""
    codes: set[float] = set()
    visited = set()
    for prim in prims:
        for above in _walk_up(prim):
            if above.GetPath() in visited:
                break
            visited.add(above.GetPath())
            if above.IsA(UsdGeom.Xformable):
                codes.update(UsdGeom.Xformable(above).GetTimeSamples())
            if above.IsA(UsdGeom.Imageable):
                codes.update(UsdGeom.Imageable(above).GetVisibilityAttr().GetTimeSamples())
    return sorted(codes)


def _dump_field(
    prim: Any, codes: list[float], prefix: str, arrays: dict[str, Any], budget: ReadBudget, losses: list[str]
) -> dict[str, Any]:
    """Puts a field's arrays among the others; the rest of it as JSON values."""
    color_attribute = None
    for name, width in WIDTHS.items():
        for attribute in (prim.GetAttribute(name), prim.GetAttribute(f"{name}h")):
            if not attribute or not attribute.HasAuthoredValue():
                continue
            if attribute.GetNumTimeSamples() > 1:
                losses.append(f"{prim.GetPath()}: of the changing {name} the first ones are read.")
            value = attribute.Get(Usd.TimeCode.EarliestTime())
            if value is not None:
                budget.spend(len(value) * width * 4)
                arrays[prefix + name] = np.asarray(value, dtype=np.float32).reshape(-1, width)
                if name == names.COEFFICIENTS:
                    color_attribute = attribute
                break
    color = UsdGeom.Gprim(prim).GetDisplayColorPrimvar()
    value = color.ComputeFlattened() if color and color.HasAuthoredValue() else None
    if value is not None and prefix + names.COEFFICIENTS not in arrays:
        budget.spend(len(value) * 12)
        arrays[prefix + names.COLORS] = np.asarray(value, dtype=np.float32).reshape(-1, 3)
        color_attribute = color.GetAttr()
    degree = prim.GetAttribute(names.DEGREE)
    node_prim = prim if prim.GetCustomDataByKey(names.NAME) is not None else prim.GetParent()
    node = _read_data(node_prim, names.NODE_ENTRIES)
    moves = bool(node.get(names.MOVES)) or any(_is_time_varying(above) for above in _walk_up(prim))
    times = codes if moves else [Usd.TimeCode.EarliestTime()]
    # OpenUSD multiplies rows from the left.
    matrices = [np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(prim)).T for code in times]
    imageable = UsdGeom.Imageable(prim)
    arrays[prefix + names.MATRICES] = np.array(matrices, dtype=np.float64).reshape(-1, 4, 4)
    arrays[prefix + names.SHOWN] = np.array(
        [imageable.ComputeVisibility(code) != UsdGeom.Tokens.invisible for code in times], dtype=bool
    )
    return {
        "path": str(prim.GetPath()),
        "degree": int(degree.Get()) if degree and degree.HasAuthoredValue() else None,
        "color_space": _find_color_space(color_attribute) if color_attribute is not None else "",
        "moves": moves,
        "node": node,
    }


def _find_color_space(attribute: Any) -> str:
    """The colour space of an attribute by OpenUSD's rule: its own, or that of the nearest prim; empty without one."""
    if attribute.HasColorSpace():
        return str(attribute.GetColorSpace())[:_COLOR_SPACE_CHARACTERS]
    for prim in _walk_up(attribute.GetPrim()):
        stated = prim.GetAttribute(names.COLOR_SPACE)
        space = stated.Get(Usd.TimeCode.EarliestTime()) if stated and stated.HasAuthoredValue() else None
        if space:
            return str(space)[:_COLOR_SPACE_CHARACTERS]
    return ""


def _walk_up(prim: Any) -> Iterator[Any]:
    while prim and not prim.IsPseudoRoot():
        yield prim
        prim = prim.GetParent()


def _is_time_varying(prim: Any) -> bool:
    if prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
        return True
    return bool(prim.IsA(UsdGeom.Imageable) and UsdGeom.Imageable(prim).GetVisibilityAttr().GetNumTimeSamples())


def _read_data(prim: Any, entries: dict[str, type]) -> dict[str, Any]:
    """Entries of ``customData`` as JSON values; what is there as another kind of value is an error."""
    values: dict[str, Any] = {}
    for name, kind in entries.items():
        value = prim.GetCustomDataByKey(name)
        if value is None:
            continue
        plain = np.array(value).tolist() if kind is list else value
        if not isinstance(plain, kind):
            raise _damage(f"the entry {name} of {prim.GetPath()} is a {type(value).__name__}")
        values[name] = plain
    return values


def _damage(problem: str) -> InputError:
    return InputError(problem, remedy="Export the scene again.")


def main() -> None:
    """Runs the process: an error of the input is left as JSON, too."""
    layer, folder, size = sys.argv[1:]
    limit_memory(int(size))
    # OpenUSD prints what it finds wrong; the delegate keeps that to itself.
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        dump_stage(Path(layer), Path(folder), int(size))
    except InputError as error:
        values = {"problem": error.problem, "remedy": error.remedy}
        Path(folder, STAGE_FILE).write_text(json.dumps({"error": values}), encoding="utf-8")
    except (Tf.ErrorException, RuntimeError, ValueError, TypeError, MemoryError) as error:
        # The caller says it in its own words.
        raise SystemExit(f"{type(error).__name__}: {error}") from None
    finally:
        del delegate


if __name__ == "__main__":
    main()
