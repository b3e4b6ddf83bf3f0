"""What a driver meets in a finished run: the recorded path, road users, and how far the scenes can be trusted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from flows.simulation.chunk_outlines import load_outlines
from flows.simulation.edited_runs import open_run
from flows.simulation.parked_actors import list_parked
from flows.simulation.recorded_settings import read_simulate_config
from flows.simulation.run_scenes import RunScenes
from flows.simulation.stored_ranges import SideRange, find_side_ranges
from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.ego_paths.bicycle import BicycleModel, VehicleState
from genre_tasks.ego_paths.collisions import Collision, find_collisions
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.frenet import place_poses
from genre_tasks.ego_paths.recorded_path import join_recorded_path
from genre_tasks.ego_paths.reference_path import ReferencePath, fit_reference_path
from genre_tasks.ego_paths.world_actors import WorldActor, list_world_actors
from genre_tasks.logs.types import Float64
from genre_tasks.logs.vehicle_center import find_center_ahead
from genre_tasks.progress import Progress
from genre_tasks.rollout.chunk_layout import ChunkLayout, lay_out_chunks

_TOLERANCE_M = 0.25
_RATE_S = 0.05


@dataclass(frozen=True)
class Place:
    """Where a vehicle is relative to the recorded path.

    Attributes:
        arc_m: along it, from its first pose.
        lateral_m: to its left.
        reliable: the scene there can be trusted.
    """

    arc_m: float
    lateral_m: float
    reliable: bool


class DrivingWorld:
    """A run to drive in.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        stage: initial, gnet or enet; ``None``: the last one of each chunk.
        reliable_m: how far to both sides of the recorded path one may drive; ``None``: as measured for
            ``genre simulate``, which takes minutes the first time and is then read from the store.
        progress: called while the range is measured.

    Attributes:
        config: the run's section ``simulate``.
        recorded: the recorded path.

    Raises:
        ConfigError: another version wrote the record, with settings of simulations that this one does not know.
        InputError: there is no such run or stage, or the recorded vehicle drives backwards.
    """

    def __init__(self, store: str, run: str, stage: str | None, reliable_m: float | None, progress: Progress) -> None:
        scenes = RunScenes(store, run, stage)
        self.config: SimulateConfig = read_simulate_config(scenes.record)
        chunks = load_outlines(scenes)
        self.recorded: EgoPath = join_recorded_path(chunks)
        moving = list_world_actors(chunks)
        opened = open_run(store, run, stage)
        recorded_chunks = load_outlines(opened.recorded) if len(opened.edits) else chunks
        self._actors: tuple[WorldActor, ...] = (*moving, *list_parked(opened.recorded, recorded_chunks))
        self._center_ahead_m = find_center_ahead(str(opened.recorded.record["log"]), self.config.center_ahead_m)
        self._reference: ReferencePath = fit_reference_path(self.recorded)
        self._layout: ChunkLayout = lay_out_chunks(scenes)
        if reliable_m is None:
            self._ranges = find_side_ranges(opened.recorded, progress)
        else:
            self._ranges = dict.fromkeys(scenes.chunk_numbers, SideRange(reliable_m, reliable_m))

    def start(self, index: int, lateral_m: float, model: BicycleModel) -> VehicleState:
        """Gives the state of the recorded vehicle at a pose, moved to the side.

        Args:
            index: of the recorded pose.
            lateral_m: to the left.
            model: for the steering angle.
        """
        time_s = self.recorded.times_s[index] - self.recorded.times_s[0]
        # At either end of the path the difference is one-sided.
        moments = np.clip([time_s - _RATE_S, time_s, time_s + _RATE_S], 0.0, self._reference.duration_s)
        speeds = self._reference.measure_speed(moments)
        points = self._reference.sample(self._reference.locate(moments[1:2]))
        heading = float(points.heading_rad[0])
        curvature = float(points.curvature_1_m[0])
        bounds = self.config.bounds
        span_s = float(moments[2] - moments[0])
        acceleration = float(speeds[2] - speeds[0]) / span_s if span_s > 0 else 0.0
        return VehicleState(
            x_m=float(points.position_m[0, 0]) - lateral_m * math.sin(heading),
            y_m=float(points.position_m[0, 1]) + lateral_m * math.cos(heading),
            heading_rad=heading,
            speed_m_s=min(float(speeds[1]), bounds.max_speed_m_s),
            acceleration_m_s2=min(max(acceleration, -bounds.max_deceleration_m_s2), bounds.max_acceleration_m_s2),
            steer_rad=model.find_steer(min(max(curvature, -bounds.max_curvature_1_m), bounds.max_curvature_1_m)),
        )

    def find_arc(self, index: int) -> float:
        """Gives how many metres the recorded vehicle has driven up to a pose.

        Args:
            index: of the recorded pose.
        """
        times = self.recorded.times_s[index : index + 1] - self.recorded.times_s[0]
        return float(self._reference.locate(times)[0])

    def locate(self, state: VehicleState, frame: float, expected_m: float) -> Place:
        """Finds where a vehicle is relative to the recorded path.

        Args:
            state: of the vehicle.
            frame: log frame of the moment.
            expected_m: about where along the path, for paths that cross themselves.
        """
        position = np.array([[state.x_m, state.y_m]])
        arc, lateral = self._reference.project(position, np.array([expected_m]))
        facing = np.array([math.cos(state.heading_rad), math.sin(state.heading_rad)])
        place = self._layout.find_place(position[0], frame, facing)
        index = max(int(np.searchsorted(self._layout.first_frames, round(place), side="right")) - 1, 0)
        side = self._ranges[self._layout.numbers[index]]
        inside = -_TOLERANCE_M <= arc[0] <= self._reference.length_m + _TOLERANCE_M
        reliable = inside and -side.right_m <= lateral[0] <= side.left_m
        return Place(float(arc[0]), float(lateral[0]), bool(reliable))

    def place_ego(self, state: VehicleState, place: Place) -> Float64:
        """Gives the pose of a vehicle: height, roll and pitch are those of the recorded one at that place.

        Args:
            state: of the vehicle.
            place: of the same moment.

        Returns:
            world_SE3_ego [4, 4].
        """
        arc = np.array([max(place.arc_m, 0.0)])
        heading = float(self._reference.sample(arc).heading_rad[0])
        pose = place_poses(self._reference, arc, np.zeros(1), np.zeros(1))[0]
        pose[:3, :3] = Rotation.from_rotvec([0.0, 0.0, state.heading_rad - heading]).as_matrix() @ pose[:3, :3]
        pose[:2, 3] = (state.x_m, state.y_m)
        return pose

    def find_collision(self, world_SE3_ego: Float64, frame: float) -> Collision | None:
        """Finds the road user that a vehicle at a pose overlaps.

        Args:
            world_SE3_ego: [4, 4].
            frame: log frame of the moment.

        Returns:
            The first of them; ``None`` where there is none.
        """
        path = EgoPath(np.zeros(1), np.array([frame]), world_SE3_ego[None])
        margin_m = self.config.collision_margin_m
        found = find_collisions(path, self._actors, margin_m, center_ahead_m=self._center_ahead_m)
        return found[0] if found else None
