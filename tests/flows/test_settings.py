"""Settings and configuration files: text where a key takes text, and one line that names key and place otherwise."""

from __future__ import annotations

import operator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flows.configuration import apply_settings, load_configuration, validate_config
from flows.configuration.absolute_paths import PATH_KEYS, make_paths_absolute, make_setting_absolute
from flows.configuration.settings import parse_setting
from genre_tasks.config import PipelineConfig
from genre_tasks.config.section import Section
from genre_tasks.errors import ConfigError

ODD_TEXTS = (
    "*.ply",
    "a: b: c",
    "%HOME%/w",
    "[front_camera",
    "!x",
    "&a",
    "@x",
    "`x`",
    "{",
    "- x",
    "=",
    "a #1.ply",
    "010",
    "1:30",
    "on",
    "2026-01-02",
    "C:\\logs\\a.ply",
    "?",
    "|",
    ">x",
    "a,b",
    "<<",
    "...",
    "---",
)


def refuse(*given_settings: str, file: Path | None = None) -> str:
    with pytest.raises(ConfigError) as caught:
        load_configuration("small", file, given_settings)
    message = str(caught.value)
    assert len(message.splitlines()) == 1 and len(message) < 800, message
    return message


@pytest.mark.parametrize("text", ODD_TEXTS)
def test_a_key_that_takes_text_takes_any(text: str) -> None:
    """Report: hydra-ecosystem/hydra#798 (an asterisk), #962 (a percent sign), #2705 (a hash sign)."""
    assert load_configuration("small", settings=[f"ingest.points={text}"]).ingest.points == text
    assert load_configuration("small", settings=[f"gnet.weights={text}"]).gnet.weights == text


def test_quotes_around_text_are_left_out_and_null_is_null() -> None:
    read = operator.attrgetter("ingest.points")
    assert read(load_configuration("small", settings=["ingest.points='null'"])) == "null"
    assert read(load_configuration("small", settings=['ingest.points="a b"'])) == "a b"
    assert read(load_configuration("small", settings=["ingest.points=null"])) is None
    assert read(load_configuration("small", settings=["ingest.points="])) is None
    assert read(load_configuration("small", settings=['ingest.points="a" b'])) == '"a" b'


@pytest.mark.parametrize("text", [*ODD_TEXTS, "\tx", "\x07", "\udce9", "[1", "NaN", ".nan", ".inf", "1e999", "8.0"])
def test_a_key_that_takes_a_number_refuses_text_in_one_line(text: str) -> None:
    """Report: hydra-ecosystem/hydra#1843."""
    # Ten as it is written, and nothing, are the only numbers among them.
    if text == "010":
        assert load_configuration("small", settings=[f"gnet.iterations={text}"]).gnet.iterations == 10
        return
    assert "gnet.iterations" in refuse(f"gnet.iterations={text}")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("ingest.cameras=[front_camera", ("ingest.cameras", "[front_camera", "[front_camera, back_camera]")),
        ("ingest.cameras=front_camera", ("ingest.cameras", "a list", "[front_camera, back_camera]")),
        ("evaluate.shifts_m=[1,,2]", ("evaluate.shifts_m", "[1.0, 2.0]")),
        ("evaluate.shifts_m=3", ("evaluate.shifts_m", "a list")),
        ("gnet.refine={split_fraction: 1", ("gnet.refine", "a section")),
        ("ingest.strict=yes", ("true or false", "'yes'")),
        ("gnet.iterations=true", ("a whole number", "true")),
        ("gnet.iterations='3'", ("a whole number", "'3'")),
        ("gnet.loss.rgb=.inf", ("finite",)),
        ("gnet.iterations=" + "9" * 399, ("10000",)),
        ("gnet.iterations=" + "9" * 5000, ("gnet.iterations",)),
        ("a\nb=1", ("no configuration key",)),
        ("x" * 5000 + "=1", ("no configuration key",)),
        ("gnet..iterations=1", ("no configuration key",)),
        ("=1", ("section.key=value",)),
        ("gnet.weights=", ("empty",)),
    ],
)
def test_other_mistakes_name_key_and_what_is_expected(setting: str, words: tuple[str, ...]) -> None:
    """Report: none found; cases 14 and 16 of the list of odd logs."""
    message = refuse(setting)
    for word in words:
        assert word in message


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=30), st.sampled_from(["ingest.points", "gnet.iterations", "ingest.cameras", "gnet.refine"]))
def test_no_text_is_a_traceback(text: str, key: str) -> None:
    """Report: facebookresearch/hydra#2891 (words in Chinese)."""
    try:
        load_configuration("small", settings=[f"{key}={text}"])
    except ConfigError as error:
        assert len(str(error).splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gnet:\n  iteration: 8\n", "line 2: there is no configuration key 'gnet.iteration'"),
        ("1: x\n", "line 1: there is no configuration key '1'"),
        ("on: x\n", "line 1: there is no configuration key 'on'"),
        ("null: x\n", "line 1: there is no configuration key 'null'"),
        ("gnet:\n  iterations: 8\ngnet:\n  seed: 1\n", "line 3: the key 'gnet' is there twice"),
        ("gnet:\n  iterations: 1:30\n", "line 2: the value of gnet.iterations"),
        ("gnet:\n  loss: {rgb: .nan}\n", "line 2: the value of gnet.loss.rgb"),
        ("\ngnet: 8\n", "line 2: 'gnet' is a section, got 8"),
        ("ingest:\n  chunk_frames: 4\n", "line 2: the value of ingest is not allowed: source_every (4)"),
    ],
)
def test_a_mistake_in_a_file_names_file_and_line(tmp_path: Path, text: str, words: str) -> None:
    """Report: none found; case 15 of the list of odd logs."""
    file = tmp_path / "own.yaml"
    file.write_text(text)
    message = refuse(file=file)
    assert words in message and "own.yaml" in message


def test_a_mistake_in_a_setting_does_not_blame_the_file(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text("gnet: {iterations: 8}\n")
    assert "own.yaml" not in refuse("gnet.iterations=0", file=file)
    assert "own.yaml" not in refuse("gnet={iterations: 0}", file=file)
    assert "own.yaml" in refuse("gnet.seed=1", "gnet.refine=null", file=_write(file, "gnet: {iterations: 0}\n"))


def _write(file: Path, text: str) -> Path:
    file.write_text(text)
    return file


@pytest.mark.parametrize("values", [[1, 2], "gnet", 8, {"gnet": {1: 2}}, {1: {}}, {"gnet": [1]}, {"gnet": None}])
def test_parameters_of_a_flow_may_be_anything(values: object) -> None:
    """Report: none found; case 16 of the list of odd logs."""
    with pytest.raises(ConfigError):
        validate_config(values, "parameters of the flow")  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", ["gnet.iterations=8", [8], [None], [{"gnet.iterations": 8}]])
def test_settings_of_a_flow_are_a_list_of_texts(wrong: object) -> None:
    """Report: none found; case 16 of the list of odd logs."""
    with pytest.raises(ConfigError, match=r"section\.key=value"):
        apply_settings(PipelineConfig(), wrong)  # type: ignore[arg-type]


def test_effects_take_words_in_every_spelling(tmp_path: Path) -> None:
    for text in ("effects: on\n", "effects: true\n", "effects: {exposure: on}\n", "effects: {exposure: true}\n"):
        file = _write(tmp_path / "c.yaml", text)
        assert load_configuration("small", file).effects.exposure == "on"
    assert load_configuration("small", settings=["effects=off"]).effects.exposure == "off"


def test_every_key_that_takes_a_file_is_made_absolute_for_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fields = [(name, field) for section in Section.__subclasses__() for name, field in section.model_fields.items()]
    files = {name for name, field in fields if "expanduser" in f"{field.annotation} {field.metadata}"}
    assert len(files) >= 4 and files | {"weights"} == PATH_KEYS
    monkeypatch.chdir(tmp_path)
    (tmp_path / "adam").mkdir()
    # A folder of that name does not make a path of a method.
    assert make_setting_absolute("gnet.method=adam") == "gnet.method=adam"
    assert make_setting_absolute("gnet.weights=adam") == f"gnet.weights={tmp_path}/adam"


@pytest.mark.parametrize(
    "setting",
    [
        "evaluate.lpips=vgg",
        "evaluate.lpips=alex",
        "gnet.weights=builtin",
        "gnet.refine.weights=builtin:gnet",
        "gnet={weights: 'builtin:enet'}",
    ],
)
def test_a_file_with_the_name_of_a_network_changes_no_setting(
    setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("vgg", "alex", "builtin", "builtin:gnet", "builtin:enet"):
        (tmp_path / name).touch()
    assert make_setting_absolute(setting) == setting
    config = load_configuration("small", settings=[setting])
    assert make_paths_absolute(config) is config


def test_paths_are_absolute_wherever_they_are_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("p.ply", "w.safetensors", "net.pt"):
        (tmp_path / name).touch()
    file = _write(tmp_path / "own.yaml", "evaluate: {inception: net.pt}\ngnet: {refine: {weights: w.safetensors}}\n")
    settings = ["ingest={points: p.ply}", "initial.scene=p.ply", "enet.weights=elsewhere", "fnet.weights=/a//b"]
    merged = load_configuration("small", file, settings)
    config = make_paths_absolute(merged)
    assert (config.ingest.points, config.initial.scene) == (f"{tmp_path}/p.ply", f"{tmp_path}/p.ply")
    assert config.evaluate.inception == f"{tmp_path}/net.pt"
    assert config.gnet.refine is not None and config.gnet.refine.weights == f"{tmp_path}/w.safetensors"
    # What is not here is named as the user wrote it, and an absolute path stays as it is written.
    assert (config.enet.weights, config.fnet.weights) == ("elsewhere", "/a//b")
    assert config.gnet.loss == merged.gnet.loss and make_paths_absolute(config) is config


def test_a_setting_of_a_section_has_absolute_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.ply").touch()
    setting = make_setting_absolute("ingest={points: p.ply, strict: true, cameras: [ü, 'on'], min_actor_travel_m: 1.5}")
    assert parse_setting(setting) == (
        ("ingest",),
        {"points": f"{tmp_path}/p.ply", "strict": True, "cameras": ["ü", "on"], "min_actor_travel_m": 1.5},
    )
    for other in ("ingest={strict: true}", "evaluate.shifts_m=[1, 2.5]", "effects=off", "gnet.iterations=.nan"):
        assert make_setting_absolute(other) == other
