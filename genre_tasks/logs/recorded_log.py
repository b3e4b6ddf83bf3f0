"""What readers of recorded logs share: questions for frames and cameras that are not there, and a list of findings."""

from __future__ import annotations

from collections.abc import Callable, Collection

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.labelled_boxes import LabelledBox, build_tracks
from genre_tasks.logs.point_values import Numbers, fill_intensities, find_placed_points
from genre_tasks.logs.types import CuboidTrack, Float32, Float64
from genre_tasks.suggestions import did_you_mean


class RecordedLog:
    """Base of readers that read files; a log of another package need not inherit it.

    Args:
        uri: what the user wrote.
    """

    # Readers know it once their tables are read.
    frame_count: int

    def __init__(self, uri: str) -> None:
        self.uri = uri
        self._findings: dict[str, Finding] = {}

    def _report(self, *findings: Finding) -> None:
        # By message, since a sweep that is read twice must count once.
        self._findings |= {finding.message: finding for finding in findings}

    def _findings_after(self, *parts: object) -> tuple[Finding, ...]:
        """Findings so far. Arguments are evaluated first: reading cameras adds what is wrong with their images."""
        return tuple(self._findings.values())

    def _build_tracks(
        self, boxes: list[LabelledBox], world_SE3_sensor: Callable[[int], Float64]
    ) -> tuple[CuboidTrack, ...]:
        tracks, findings = build_tracks(boxes, world_SE3_sensor, self.frame_count)
        self._report(*findings)
        return tracks

    def _find_placed(self, points: Float32 | Float64, frame: int) -> NDArray[np.bool_]:
        """[N] which of the points [N, 3] have a finite place; reports that the others are left out."""
        placed, findings = find_placed_points(points, frame)
        self._report(*findings)
        return placed

    def _fill_intensities(self, values: Numbers, frame: int) -> Numbers:
        """[N] intensities as the file has them, with 0 where one is missing, which is reported."""
        filled, findings = fill_intensities(values, frame)
        self._report(*findings)
        return filled

    def _check_frame(self, frame: int) -> int:
        if not 0 <= frame < self.frame_count:
            remedy = f"The log has frames 0 to {self.frame_count - 1}."
            raise InputError("no such frame", remedy=remedy, log=self.uri, frame=frame)
        return frame

    def _check_camera_among(self, names: Collection[str], camera: str, frame: int) -> str:
        if camera not in names:
            # A log whose images are all missing has no camera to suggest.
            remedy = f"{did_you_mean(camera, names)}The log has {', '.join(names) or 'no camera'}."
            raise InputError("no such camera", remedy=remedy, log=self.uri, camera=camera, frame=frame)
        return camera
