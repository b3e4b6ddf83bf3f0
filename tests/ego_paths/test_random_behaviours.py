"""A thousand random behaviours: all of them within the bounds, or one clear error."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.ego_paths.behaviours import BEHAVIOURS, plan_behaviour
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.kinematics import find_bound_violations
from genre_tasks.errors import ConfigError
from tests.ego_paths.drives import drive

CONFIG = SimulateConfig()
SPEEDS = ("steady", "slowing", "gaining", "standing", "waving", "starting")


@dataclass(frozen=True)
class Recording:
    """A recorded path: speed, how it changes, how the road bends, and how the poses jitter."""

    kind: str
    frames: int
    speed_m_s: float
    change_m_s2: float
    bend: float
    bend_length_m: float
    jitter_m: float
    seed: int

    def speed(self, t: np.ndarray) -> np.ndarray:
        return {
            "steady": np.full_like(t, self.speed_m_s),
            "slowing": np.clip(self.speed_m_s - self.change_m_s2 * t, 0, None),
            "gaining": np.clip(self.speed_m_s + self.change_m_s2 * t, 0, 30),
            "standing": np.zeros_like(t),
            "waving": self.speed_m_s * (1 + 0.2 * np.sin(0.7 * t + self.seed)),
            "starting": np.clip(2 * (t - 1.5), 0, self.speed_m_s),
        }[self.kind]

    def path(self) -> EgoPath:
        fastest = max(1.0, float(self.speed(np.linspace(0, 0.1 * self.frames, 50)).max()))
        # As much as a lateral acceleration of 2.5 m/s² and a small crossroads have.
        largest = self.bend * min(0.08, 2.5 / fastest**2)
        return drive(
            self.frames,
            self.speed,
            lambda s: largest * np.cos(s / self.bend_length_m),
            jitter_m=self.jitter_m,
            jitter_rad=0.2 * self.jitter_m,
            seed=self.seed,
            heading=self.seed,
            origin=(4e6 * (self.seed % 2), 10.0, 5.0),
        )


recordings = st.builds(
    Recording,
    kind=st.sampled_from(SPEEDS),
    frames=st.integers(12, 80),
    speed_m_s=st.floats(0.0, 18.0),
    change_m_s2=st.floats(0.0, 3.0),
    bend=st.floats(-1.0, 1.0),
    bend_length_m=st.floats(8.0, 1000.0),
    jitter_m=st.sampled_from([0.0, 0.003, 0.01]),
    seed=st.integers(0, 1000),
)


def test_a_thousand_random_behaviours_keep_within_the_bounds() -> None:
    outcomes: Counter[str] = Counter()

    @settings(
        max_examples=1000,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(
        recording=recordings,
        name=st.sampled_from(sorted(BEHAVIOURS)),
        offset_m=st.floats(-4.0, 4.0),
        strength=st.floats(0.0, 1.6),
        delay_s=st.floats(0.0, 1.0),
        side=st.sampled_from([None, "left", "right"]),
    )
    def plan(recording: Recording, name: str, offset_m: float, strength: float, delay_s: float, side: str) -> None:
        recorded = recording.path()
        try:
            path = plan_behaviour(
                name,
                recorded,
                CONFIG,
                start_offset_m=offset_m,
                strength=strength,
                delay_s=delay_s,
                side=side if BEHAVIOURS[name].has_side else None,  # type: ignore[arg-type]
            )
        except ConfigError as error:
            # Nothing but a log that is too short, or jitter that bends the recorded path itself.
            is_short = BEHAVIOURS[name].has_side and "the recorded path has" in error.problem
            outcomes["too short" if is_short else "refused"] += 1
            assert is_short or "the recorded path itself" in error.problem, error
            assert any(letter.isdigit() for letter in error.problem)
            return
        outcomes[name] += 1
        assert find_bound_violations(path, CONFIG.bounds) == ()
        assert np.isfinite(path.world_SE3_ego).all()
        rotation = path.world_SE3_ego[:, :3, :3]
        assert np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max() < 1e-6
        start = (np.linalg.inv(recorded.world_SE3_ego[0]) @ path.world_SE3_ego[0])[:2, 3]
        assert np.abs(start - [0.0, offset_m]).max() < 0.1 + 20 * recording.jitter_m

    plan()
    total = sum(outcomes.values())
    assert total >= 1000
    assert outcomes["refused"] < 0.02 * total, outcomes
    assert outcomes["too short"] < 0.35 * total, outcomes
    assert all(outcomes[name] > 30 for name in BEHAVIOURS), outcomes
