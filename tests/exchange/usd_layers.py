"""OpenUSD layers as other programs write them, and how tests read them without a process for each."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdVol

from genre_tasks.errors import InputError
from genre_tasks.exchange.usd.stage_dump import ARRAYS_FILE, STAGE_FILE, dump_stage


@pytest.fixture
def real_process() -> None:
    """Asks for the process of its own that reads a file."""


@pytest.fixture(autouse=True)
def read_in_this_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of files are read here, and to start a process for each takes half a second."""

    def dump(layer: Path, folder: Path, file: Path) -> tuple[dict[str, Any], dict[str, Any]]:
        try:
            dump_stage(layer, folder, file.stat().st_size)
        except InputError as error:
            raise InputError(error.problem, remedy=error.remedy, file=file) from error
        with np.load(folder / ARRAYS_FILE) as arrays:
            return json.loads((folder / STAGE_FILE).read_text()), dict(arrays)

    if "real_process" not in request.fixturenames:
        monkeypatch.setattr("genre_tasks.exchange.usd.format.run_stage_dump", dump)


def make_layer(path: Path, **arrays: object) -> Any:
    """A layer of two Gaussians, as another program writes it: y up, centimetres, no customData; its stage."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/World/splat").GetPrim()
    values: dict[str, object] = {
        "positions": [(100, 200, 300), (0, 0, 0)],
        "scales": [(10, 20, 30), (1, 1, 1)],
        "orientations": [Gf.Quatf(1, 0, 0, 0), Gf.Quatf(0, 1, 0, 0)],
        "opacities": [0.25, 0.5],
        "radiance:sphericalHarmonicsDegree": 0,
        "radiance:sphericalHarmonicsCoefficients": [(0.1, 0.2, 0.3), (0.4, 0.5, 0.6)],
    }
    for name, value in (values | arrays).items():
        if value is not None:
            assert field.GetAttribute(name).Set(value), name
    stage.GetRootLayer().Save()
    return stage


def write_zip(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> None:
    """An archive with these members."""
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
