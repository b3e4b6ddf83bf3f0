"""Bad input through the real command: one clear error with file, frame and remedy, exit code ≠ 0, nothing half-made."""

from __future__ import annotations

import gzip
import json
import os
import pickle
import resource
import subprocess
from pathlib import Path

import pytest

from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from tests.faults import small_run

STREET = "synthetic:street?seed=904&frames=8&cameras=1&width=64&height=36&lidar_beams=16&lidar_azimuths=200"


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pandaset(open_log(STREET), tmp_path_factory.mktemp("pandaset") / "904")


@pytest.fixture
def log(sequence: Path, tmp_path: Path) -> Path:
    import shutil

    return Path(shutil.copytree(sequence, tmp_path / "904"))


class Hostile:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch hostile-was-here",)


def assert_refused(folder: Path, *args: str, words: tuple[str, ...]) -> None:
    done = small_run.genre(folder, *args)
    assert done.returncode not in (0, -9), done.stdout
    # One object, which says the same as the line on stderr.
    outcome = json.loads(done.stdout)
    assert outcome["exit_code"] == done.returncode and outcome["status"] in ("refused", "failed")
    assert outcome["error"]["message"] in done.stderr
    error = done.stderr.strip().splitlines()[-1]
    for word in words:
        assert word in error, done.stderr[-2000:]
    assert "Traceback" not in done.stderr
    store = folder / "store"
    assert not [p for p in store.rglob("*") if p.is_file() and "runs" not in p.parts and ".tmp" in str(p)]


def run_of(log: Path | str, store: Path, *more: str) -> list[str]:
    uri = log if isinstance(log, str) else f"pandaset:{log}"
    return [uri if part == small_run.LOG else part for part in small_run.arguments(store, *more)]


def test_no_such_log(tmp_path: Path) -> None:
    assert_refused(tmp_path, *run_of(tmp_path / "nowhere", tmp_path / "store"), words=("error:", "nowhere"))


def test_unknown_reader(tmp_path: Path) -> None:
    assert_refused(tmp_path, *run_of("pandset:x/002", tmp_path / "store"), words=("pandset", "pandaset"))


def test_unknown_configuration_key(tmp_path: Path) -> None:
    more = ("--set", "gnet.iteratons=8")
    assert_refused(
        tmp_path, *run_of(STREET, tmp_path / "store", *more), words=("gnet.iteratons", "Did you mean 'gnet.iterations'")
    )


@pytest.mark.slow
def test_no_lidar(tmp_path: Path) -> None:
    assert_refused(tmp_path, *run_of(STREET + "&lidar=0", tmp_path / "store"), words=("LiDAR", "ingest.points"))


@pytest.mark.slow
def test_a_corrupt_image_under_strict(log: Path, tmp_path: Path) -> None:
    file = log / "camera/front_camera/04.png"
    file.write_bytes(file.read_bytes()[:300])
    words = ("frame 4", "front_camera", "strict")
    assert_refused(tmp_path, *run_of(log, tmp_path / "store", "--strict"), words=words)


@pytest.mark.slow
def test_a_pose_that_is_not_a_number(log: Path, tmp_path: Path) -> None:
    file = log / "camera/front_camera/poses.json"
    poses = json.loads(file.read_text())
    poses[4]["position"]["x"] = float("nan")
    file.write_text(json.dumps(poses))
    assert_refused(tmp_path, *run_of(log, tmp_path / "store", "--strict"), words=("poses.json", "frame 4"))


@pytest.mark.slow
def test_a_pickle_that_tries_to_run_code(log: Path, tmp_path: Path) -> None:
    with gzip.open(log / "lidar/02.pkl.gz", "wb") as stream:
        pickle.dump(Hostile(), stream)
    assert_refused(tmp_path, *run_of(log, tmp_path / "store", "--strict"), words=("02.pkl.gz", "system"))
    assert not (tmp_path / "hostile-was-here").exists()


@pytest.mark.slow
def test_a_full_disk(tmp_path: Path) -> None:
    """A limit on file sizes stands for the full disk: the kernel refuses the write in the same place."""
    command = [small_run.GENRE, *small_run.arguments(tmp_path / "store")]
    env = small_run.environment(tmp_path)

    def limit() -> None:
        import signal

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, 2_000_000))

    with small_run.prefect_server(tmp_path) as url:
        done = subprocess.run(
            [*command, "--set", "initial.max_points=60000", "--set", "initial.distant_count=60000"],
            env=env | {"PREFECT_API_URL": url},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            preexec_fn=limit,
            check=False,
        )
    assert done.returncode == 1, done.stderr[-2000:]
    assert "store" in done.stderr and "Traceback" not in done.stderr
    assert not list((tmp_path / "store").rglob(".tmp-*"))
