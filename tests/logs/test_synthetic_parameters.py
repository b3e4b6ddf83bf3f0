"""What a user may ask of the synthetic street, and what is refused."""

import re

import pytest

from genre_tasks.errors import ConfigError
from genre_tasks.logs.synthetic import SyntheticStreet, open_synthetic
from genre_tasks.logs.synthetic.parameters import parse_parameters


def test_defaults():
    p = parse_parameters({})
    assert (p.seed, p.frames, p.cameras, p.width, p.height, p.samples) == (0, 20, 3, 320, 180, 4)
    assert (p.lidar_beams, p.lidar_azimuths) == (64, 900)


def test_unknown_parameter_names_the_nearest():
    with pytest.raises(ConfigError, match="Did you mean 'cameras'") as caught:
        parse_parameters({"camera": "3"})
    assert "'camera'" in caught.value.problem


def test_unknown_parameter_without_neighbour_lists_all():
    with pytest.raises(ConfigError, match="lidar_beams"):
        parse_parameters({"zzz": "3"})


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("frames", "0"),
        ("frames", "201"),
        ("cameras", "7"),
        ("seed", "-1"),
        ("cuboids", "2"),
        ("width", "100000"),
        ("origin_m", "nan"),
        ("noise_m", "-0.1"),
        ("samples", "5"),
    ],
)
def test_out_of_range_values_are_refused(key: str, text: str):
    with pytest.raises(ConfigError, match=key):
        parse_parameters({key: text})


@pytest.mark.parametrize("text", ["twelve", "1.5", ""])
def test_not_a_whole_number(text: str):
    with pytest.raises(ConfigError, match="not a whole number"):
        parse_parameters({"frames": text})


@pytest.mark.parametrize("rest", ["town?seed=1", "", "street?seed", "street?seed=1&seed=2"])
def test_bad_uris_are_refused(rest: str):
    with pytest.raises(ConfigError):
        open_synthetic(rest)


def test_uri_name_and_dataset():
    log = open_synthetic("street?seed=1000&frames=12&cameras=3")
    assert log.uri == "synthetic:street?seed=1000&frames=12&cameras=3"
    assert log.name == "street-seed=1000-frames=12"
    assert log.dataset == "synthetic"
    assert open_synthetic("street").name == "street-seed=0"


def test_name_is_a_safe_folder():
    log = SyntheticStreet({"seed": "3", "origin_m": "-1e6", "noise_m": "0.02"})
    assert re.fullmatch(r"[A-Za-z0-9_.=+-]+", log.name)


def test_name_tells_nearby_values_apart():
    names = {SyntheticStreet({"origin_m": v}).name for v in ("1000000", "1000001", "1000000.5")}
    assert len(names) == 3
