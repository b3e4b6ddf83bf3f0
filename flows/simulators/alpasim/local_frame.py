"""The coordinates that AlpaSim is spoken to in: a local frame near the origin, and a rig on the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flows.simulation.recorded_settings import read_simulate_config
from flows.simulation.run_scenes import RunScenes
from genre_tasks.ego_paths.collisions import EGO_SIZE_M
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.logs.types import Float64
from genre_tasks.logs.vehicle_center import REAR_AXLE_TO_CENTER_M, find_center_ahead
from genre_tasks.scene.transforms import compose_se3, invert_se3
from genre_tasks.scene_edits.chunk_scene import ChunkScene, SceneSource
from genre_tasks.scene_edits.ground import Ground
from genre_tasks.scene_edits.run_survey import survey_run

_SAMPLES = 20


@dataclass(frozen=True)
class LocalFrame:
    """How a run's coordinates and those of the simulator belong together.

    Positions on the wire are float32, so a log's world coordinates would lose centimetres far from its origin.

    Attributes:
        world_SE3_local: [4, 4] a translation to the first pose of the rig; axes are the log's, with z up.
        ego_SE3_rig: [4, 4] from the ego pose down to the ground and along the vehicle to the rear axle.
    """

    world_SE3_local: Float64
    ego_SE3_rig: Float64

    @staticmethod
    def from_path(path: EgoPath, ground: Ground, center_ahead_m: float = 0.0) -> LocalFrame:
        """Measures how high the ego pose is above the ground.

        Args:
            path: recorded.
            ground: of the run.
            center_ahead_m: how far ahead of the ego pose the middle of the vehicle is.

        >>> path = EgoPath(np.zeros(1), np.zeros(1), np.eye(4)[None])
        >>> frame = LocalFrame.from_path(path, Ground(np.zeros((0, 3)), np.array([[0.0, 0.0, -1.5]])))
        >>> frame.world_SE3_local[:3, 3].tolist()
        [-1.4, 0.0, -1.5]
        """
        rows = np.unique(np.linspace(0, len(path) - 1, _SAMPLES).astype(np.int64))
        positions = path.world_SE3_ego[rows, :3, 3]
        # The median: the ground is measured worse where LiDAR saw little of it.
        height = float(np.median(positions[:, 2] - ground.measure(positions[:, :2])[0]))
        ego_SE3_rig = compose_se3(np.eye(3), np.array([center_ahead_m - REAR_AXLE_TO_CENTER_M, 0.0, -height]))
        origin = (path.world_SE3_ego[0] @ ego_SE3_rig)[:3, 3]
        return LocalFrame(compose_se3(np.eye(3), origin), ego_SE3_rig)

    def to_local(self, world_SE3_body: Float64) -> Float64:
        """Takes poses [..., 4, 4] of the log's world to the local frame."""
        return invert_se3(self.world_SE3_local) @ world_SE3_body

    def to_world(self, local_SE3_body: Float64) -> Float64:
        """Takes poses [..., 4, 4] of the local frame to the log's world."""
        return self.world_SE3_local @ local_SE3_body

    def to_rig(self, ego_SE3_body: Float64) -> Float64:
        """Takes poses [..., 4, 4] on the ego vehicle to the rig."""
        return invert_se3(self.ego_SE3_rig) @ ego_SE3_body

    def place_rig(self, world_SE3_ego: Float64) -> Float64:
        """Gives the rig's poses [..., 4, 4] in the local frame, from ego poses in the log's world."""
        return self.to_local(world_SE3_ego @ self.ego_SE3_rig)


def read_local_frame(source: RunScenes) -> LocalFrame:
    """Reads where a run's local frame is, from its first chunk and its log.

    Args:
        source: the scenes of the run.

    Returns:
        The frame; the same for the bundle and for the service.

    Raises:
        ConfigError: another version wrote the record, with settings of simulations that this one does not know.
        InputError: an artifact is gone.
    """
    # One chunk: the others would only be read to measure the same height again.
    survey = survey_run(_FirstChunk(source))
    stated_m = read_simulate_config(source.record).center_ahead_m
    return LocalFrame.from_path(survey.path, survey.ground, find_center_ahead(str(source.record["log"]), stated_m))


class _FirstChunk:
    """The first chunk of a run; a ``SceneSource``."""

    def __init__(self, source: SceneSource) -> None:
        self._source = source

    @property
    def chunk_numbers(self) -> Sequence[int]:
        return self._source.chunk_numbers[:1]

    def load(self, number: int) -> ChunkScene:
        return self._source.load(number)


def describe_ego_box() -> dict[str, list[float]]:
    """Describes the ego vehicle's box in the rig, as a bundle states it.

    Returns:
        ``centroid`` and ``dim`` in metres, and ``rot`` in radians.

    >>> describe_ego_box()["rot"]
    [0.0, 0.0, 0.0]
    """
    return {
        "centroid": [REAR_AXLE_TO_CENTER_M, 0.0, EGO_SIZE_M[2] / 2],
        "dim": list(EGO_SIZE_M),
        "rot": [0.0, 0.0, 0.0],
    }
