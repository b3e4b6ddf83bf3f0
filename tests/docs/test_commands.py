"""Every ``genre`` command of the README and the guides runs, on small logs and with small settings.

A command is what stands in a ``bash`` block. Names of logs and runs are replaced by small ones of the test.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from flows.cli.main import app
from flows.reconstruction.stored_values import read_stage_scene, read_stage_value
from genre_tasks.config import SimulateConfig
from genre_tasks.ego_paths.behaviours import plan_behaviour
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.exchange.clouds import transform_cloud
from genre_tasks.exchange.conversion import pose_scene, to_exchange_scene
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.ply import PLY
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from tests.faults.small_run import LOG, SETTINGS
from tests.logs.kitti_folder import DRIVE, write_kitti, write_tracking_labels
from tests.logs.nuscenes_folder import write_nuscenes
from tests.logs.posed_images_folder import write_transforms
from tests.logs.waymo_folder import write_waymo

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", ROOT / "docs/quickstart.md", *sorted((ROOT / "docs/guides").glob("*.md")))
OTHER_LOG = re.sub(r"seed=\d+", "seed=899", LOG)
TAKES_SETTINGS = ("run", "enhance", "effects", "cost", "table", "figure")
READS_STORE = (
    *("show", "diff", "render", "view", "range", "perceive", "verify"),
    *("simulate", "edit", "export", "import", "serve"),
)
TAKES_STORE = (*TAKES_SETTINGS, *READS_STORE)


def commands(page: Path) -> list[str]:
    """The ``genre`` commands of a page's ``bash`` blocks, in order."""
    blocks = re.findall(r"```bash\n(.*?)```", page.read_text(), flags=re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.startswith("genre ")]


# A command that several pages have is run once, in its first place.
PAGES_OF: dict[str, list[str]] = {}
for _page in PAGES:
    for _command in commands(_page):
        PAGES_OF.setdefault(_command.split("   #")[0].rstrip(), []).append(_page.stem)
FOUND = [
    pytest.param(command, id=f"{', '.join(dict.fromkeys(pages))}: {command}") for command, pages in PAGES_OF.items()
]


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str, str]]:
    """A folder with a store, a finished small run in it, and a small log in the PandaSet layout.

    Yields the folder, the run's name and the log's URI.
    """
    from prefect.testing.utilities import prefect_test_harness

    from flows.reconstruction.flow import reconstruct_log

    folder = tmp_path_factory.mktemp("commands")
    write_pandaset(open_log(LOG), folder / "pandaset/002")
    write_kitti(open_log(LOG), folder / "kitti", camera_count=1)
    write_tracking_labels(open_log(LOG), folder / "kitti/labels.txt")
    write_nuscenes(open_log(LOG), folder / "nuscenes")
    write_waymo(open_log(LOG), folder / "waymo/training")
    guide = (ROOT / "docs/guides/simulation.md").read_text()
    (folder / "edits.yaml").write_text(re.findall(r"```yaml\n(.*?)```", guide, flags=re.DOTALL)[0])
    with prefect_test_harness(server_startup_timeout=120):
        done = reconstruct_log(LOG, preset="demo", store=str(folder / "store"), settings=list(SETTINGS))
        write_scene_files(folder, done["run"])
        yield folder, done["run"], f"pandaset:{folder}/pandaset/002"


def scene_key(folder: Path, run: str) -> str:
    """The key of the last scene of a run."""
    record = json.loads((folder / "store/runs" / run / "run.json").read_text())
    return next(stage["key"] for stage in record["chunks"][0]["stages"] if stage["stage"] == "enet")


def write_scene_files(folder: Path, run: str) -> None:
    """What ``genre enhance`` takes: a scene, its images and poses, and points."""
    _, chunk = read_stage_value(str(folder / "store"), run, 0, "ingest")
    scene = read_stage_scene(str(folder / "store"), run, 0, "initial")
    cloud = pose_scene(to_exchange_scene(scene, (), (), chunk.world_SE3_chunk, names={}), None)
    PLY.write(folder / "scene.ply", make_resting_scene(transform_cloud(cloud, chunk.world_SE3_chunk)))
    write_transforms(folder, street=LOG)
    points = chunk.static.positions + chunk.world_SE3_chunk[:3, 3]
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "property double x\nproperty double y\nproperty double z\nend_header\n"
    (folder / "points.ply").write_text(header + "\n".join(" ".join(map(repr, row)) for row in points.tolist()))


def small(command: str, folder: Path, run: str, pandaset: str) -> list[str]:
    """The command's arguments, with the test's log, run, store and settings in place of the page's."""
    words = shlex.split(command.split("   #")[0])[1:]
    # A detector is tested on other logs than it was trained on.
    tested = {k + 1 for k, word in enumerate(words) if word == "--test"}
    logs = [OTHER_LOG if k in tested else LOG for k in range(len(words))]
    words = [re.sub(r"^synthetic:street\?seed=\d+$", log, word) for word, log in zip(words, logs, strict=True)]
    words = [run if word in ("RUN", "OTHER") else word for word in words]
    words = [scene_key(folder, run) if word == "KEY" else word for word in words]
    words = [pandaset if word == "pandaset:/data/pandaset/002" else word for word in words]
    words = [word.replace("/data/kitti/label_02/0001.txt", f"{folder}/kitti/labels.txt") for word in words]
    words = [re.sub(r"/data/kitti/\w+/\w+", f"{folder}/kitti/{DRIVE}", word) for word in words]
    words = [re.sub(r"/data/(nuscenes|waymo)/", rf"{folder}/\1/", word) for word in words]
    if "--budget" in words:  # a budget chooses these settings itself, and is not given them
        return [*words, "--store", str(folder / "store"), "--dry-run"]
    if words[0] == "simulate":
        # A log of eight frames has no room to change lanes, and its street is full of cars.
        words += ["--allow-collision", "--no-range"]
        words += ["--strength", "0.005"] if {"lane-change", "swerve"} & set(words) else []
    if words[0] == "serve":
        # Whatever else runs here may have taken the page's ports.
        words += ["--port", "0", "--metrics-port", "0"]
    more = ("gnet.per_scene.iterations=20",) if words[0] in ("table", "figure") else ()
    sets = [part for setting in (*SETTINGS, *more) for part in ("--set", setting)]
    sets = sets if words[0] in TAKES_SETTINGS else []
    if words[0] in ("run", "enhance") and LOG not in words:
        # Distances between sets of images take long, and are those of the street's run whatever reads the log.
        sets += ["--set", "evaluate.distributions=false"]
    store = ["--store", str(folder / "store")] if words[0] in TAKES_STORE else []
    return [*words[:1], *sets, *store, *words[1:]]


@pytest.mark.parametrize("command", FOUND)
def test_a_command_of_the_documents_runs(
    command: str, workplace: tuple[Path, str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if "--detector" in command:
        pytest.skip("the detector is a file that the user brings")
    monkeypatch.chdir(workplace[0])
    monkeypatch.setenv("PREFECT_HOME", str(workplace[0] / "prefect"))  # as the command itself sets it
    # A service would answer until a signal.
    monkeypatch.setattr("flows.cli.serve._wait", lambda service: None)
    done = CliRunner().invoke(app, small(command, *workplace), catch_exceptions=False)
    assert done.exit_code == 0, done.output


def test_the_documents_behaviours_fit_the_log_of_the_quickstart() -> None:
    # The commands above run on eight frames, at a strength that fits them; these are the documents' own.
    log = open_log("synthetic:street?seed=1000")
    poses = np.stack([log.world_SE3_lidar(frame) for frame in range(log.frame_count)])
    frames = np.arange(log.frame_count, dtype=np.float64)
    recorded = EgoPath(0.1 * frames, frames, poses)
    config = SimulateConfig()
    found = {behaviour for page in PAGES for behaviour in re.findall(r"--behaviour ([\w-]+)", page.read_text())}
    assert found >= {"brake", "lane-change"}
    for behaviour in found:
        assert len(plan_behaviour(behaviour, recorded, config, start_offset_m=config.start_offset_m)) == 20


def test_the_readme_has_commands() -> None:
    assert len(commands(ROOT / "README.md")) >= 6
