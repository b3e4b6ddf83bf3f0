"""``genre effects``: a table, a Parquet file and a picture; words in the configuration."""

from __future__ import annotations

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from flows.cli.main import app
from flows.configuration import load_configuration
from genre_tasks.config import EffectsConfig
from genre_tasks.errors import ConfigError

STREET = "synthetic:street?seed=1020&frames=8&cameras=1&width=96&height=54&samples=1"
SMALL = ["--set", "ingest.width_px=96", "--set", "ingest.height_px=54"]


def test_the_command_says_why_and_writes_what_anyone_can_open(tmp_path) -> None:
    told = [STREET, *SMALL, "--store", str(tmp_path / "store"), "--out", str(tmp_path / "out")]
    names = ("own/nobody.png", "points.parquet", "poses.parquet", "ego_points.parquet")
    stale = [tmp_path / "out" / name for name in names]
    # An ego mask would write points of its own over the stale ones.
    settings = ["--set", "effects.darkness=off", "--set", "effects.ego_mask=off"]
    for _ in range(2):  # the second time from the store, and over the first one's files
        done = CliRunner().invoke(app, ["effects", *told, *settings], terminal_width=200)
        assert done.exit_code == 0, done.output
        assert not any(path.exists() and not path.stat().st_size for path in stale)
        for path in stale:  # as of another plan
            path.parent.mkdir(exist_ok=True)
            path.touch()
    assert "rolling_shutter" in done.output and "96×54" in done.output
    elsewhere = tmp_path / "training" / "own" / "image.png"
    elsewhere.parent.mkdir(parents=True)
    elsewhere.touch()
    done = CliRunner().invoke(app, ["effects", *told[:-1], str(tmp_path / "training")], terminal_width=200)
    assert done.exit_code == 0 and elsewhere.exists()  # a folder of the user's that no plan was written to
    table = pq.read_table(tmp_path / "out" / "effects.parquet").to_pydict()
    assert table["name"] == list(EffectsConfig.model_fields)
    assert table["choice"][table["name"].index("darkness")] == "off"
    assert (tmp_path / "out" / "effects.png").read_bytes()[:4] == b"\x89PNG"
    assert not [p for p in (tmp_path / "out").iterdir() if p.name.startswith("tmp")]


def test_the_command_names_the_size_at_which_the_chunk_is_used(tmp_path) -> None:
    wide = STREET.replace("height=54", "height=32")
    done = CliRunner().invoke(app, ["effects", wide, *SMALL, "--store", str(tmp_path), "--set", "effects=off"])
    assert done.exit_code == 0, done.output
    assert "chunk 0, 96×32" in done.output.replace("\n", " ") and "96×54" not in done.output


@pytest.mark.parametrize(
    ("setting", "word"),
    [("effects=none", "off"), ("effects=off", "off"), ("effects=on", "on"), ("effects=auto", "auto")],
)
def test_one_word_sets_all_effects(setting: str, word: str) -> None:
    found = load_configuration("small", settings=[setting, "effects.exposure=auto"]).effects
    assert found.exposure == "auto" and found.rigid_actors == word


def test_other_words_and_names_are_refused() -> None:
    with pytest.raises(ConfigError, match="pose_refinement"):
        load_configuration("small", settings=["effects=sometimes"])
    with pytest.raises(ConfigError, match=r"no configuration key 'effects.rolling_shuter'.*rolling_shutter"):
        load_configuration("small", settings=["effects.rolling_shuter=on"])
