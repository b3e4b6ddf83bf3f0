"""One browser at the live viewer: its scene, its controls and its camera, independent of all other browsers."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from flows.simulation.stored_ranges import SideRange
from flows.viewer.chunk_drawing import ChunkDrawing, Frusta
from flows.viewer.path_drawing import CameraImage
from flows.viewer.viewed_chunks import ViewedChunk, ViewedRun
from genre_tasks.errors import GenreError
from genre_tasks.scene.transforms import shift_laterally

MAX_OFFSET_M = 6.0
FRUSTA: tuple[Frusta, ...] = ("this frame", "all frames", "none")
_LOOK_AHEAD_M = 10.0
_NO_CAMERA = "none"
_NO_PIXELS = np.zeros((1, 1, 3), np.uint8)
_RANGE_WAITS = "The reliable range is being computed, which takes a minute once."


class ClientSession:
    """What one client sees. All of it is rebuilt when the client chooses another chunk or stage.

    Args:
        client: of viser.
        run: that is shown.
        viewed: the chunk to begin with.
        with_range: whether the reliable range is drawn, and computed where it is not known.

    Attributes:
        drawing: the chunk in the client's scene.
        frame: slider of the log frame.
        play: whether time runs.
        drive: whether the camera follows the recorded path.
        offset: slider of metres to the left of the path.
    """

    def __init__(self, client: viser.ClientHandle, run: ViewedRun, viewed: ViewedChunk, with_range: bool) -> None:
        self._client = client
        self._run = run
        self._with_range = with_range
        self._playing_s = 0.0
        self._wanted = (viewed.number, viewed.stage)
        # Callbacks come from many threads; one at a time changes the scene and the controls.
        self._lock = threading.RLock()
        with self._lock:
            self.drawing = ChunkDrawing.draw(client.scene, viewed)
            self._add_controls()

    def tick(self, seconds: float) -> None:
        """Lets time run on while the client plays.

        Args:
            seconds: since the last tick.
        """
        with self._lock:
            times_s = self.drawing.viewed.times_s
            if not self.play.value or len(times_s) < 2:
                return
            self._playing_s += seconds
            if self._playing_s > times_s[-1] + times_s[1]:
                self._playing_s = 0.0
            row = int(np.searchsorted(times_s, self._playing_s, side="right")) - 1
            # The slider's own callback moves the scene.
            _set_value(self.frame, self.drawing.viewed.frames[max(row, 0)])

    def draw_range(self) -> None:
        """Draws the reliable range, where it is asked for; it may take a minute, in which the client looks about."""
        viewed = self.drawing.viewed
        if not self._with_range:
            return
        try:
            sides: SideRange | None = self._run.find_range(viewed.number, viewed.stage)
            note = ""
        except (GenreError, OSError) as error:
            sides = None
            note = f"The reliable range is not known: {_escape_markdown(str(error))}"
        with self._lock:
            # The client may have gone on to another chunk meanwhile.
            if self.drawing.viewed is not viewed:
                return
            if sides is not None:
                self.drawing.draw_range(self._client.scene, sides)
                self._show_range(self._switches["reliable range"].value)
                note = f"Reliable: {sides.left_m:.1f} m to the left, {sides.right_m:.1f} m to the right."
            self._range_note.content = note

    def _replace(self, viewed: ViewedChunk) -> None:
        with self._lock:
            before = self.drawing
            before.remove()
            self.drawing = ChunkDrawing.draw(self._client.scene, viewed)
            # Stages are compared from one place and in one moment, so all choices stay.
            controls = {name: control.value for name, control in self._controls().items()}
            if _needs_new_controls(before.viewed, viewed):
                self._add_controls()
                for name, control in self._controls().items():
                    if name in controls and _accepts(control, controls[name]):
                        _set_value(control, controls[name])
            else:
                self._heading.content = _describe_chunk(viewed)
                self._range_note.content = _RANGE_WAITS if self._with_range else ""
                for name, change in self._changes.items():
                    change(self._switches[name].value)
                self._show_frame()
                self._change_drive()
        self.draw_range()

    def _controls(self) -> dict[str, Any]:
        switches = {f"show {name}": switch for name, switch in self._switches.items()}
        named = {"frame": self.frame, "camera": self.camera, "frusta": self._frusta, "play": self.play}
        return {**named, **switches, "offset": self.offset, "drive": self.drive}

    def _add_controls(self) -> None:
        viewed = self.drawing.viewed
        self._client.gui.reset()
        self._switches: dict[str, Any] = {}
        self._changes: dict[str, Callable[[bool], None]] = {}
        self._add_choices(viewed)
        self._add_time(viewed)
        self._add_drive(viewed)
        self._add_visibility(viewed)
        self._follow()

    def _add_choices(self, viewed: ViewedChunk) -> None:
        gui = self._client.gui
        self._heading = gui.add_markdown(_describe_chunk(viewed))
        numbers = tuple(map(str, self._run.chunk_numbers))
        chunk = gui.add_dropdown("Chunk", numbers, initial_value=str(viewed.number), visible=len(numbers) > 1)
        stages = self._run.list_stages(viewed.number)
        stage = gui.add_dropdown("Stage", stages, initial_value=viewed.stage, visible=len(stages) > 1)
        self._on_update(chunk, lambda: self._choose(int(chunk.value), None))
        self._on_update(stage, lambda: self._choose(viewed.number, stage.value))

    def _choose(self, number: int, stage: str | None) -> None:
        number, chosen = self._run.select(number, stage)
        self._wanted = (number, chosen)
        viewed = self._run.load(number, chosen)
        # Reading takes seconds, in which the client may have chosen again.
        if self._wanted == (number, chosen):
            self._replace(viewed)

    def _add_time(self, viewed: ViewedChunk) -> None:
        gui = self._client.gui
        first = viewed.frames[0]
        self.frame = gui.add_slider("Frame", first, viewed.frames[-1], 1, first)
        self._time = gui.add_text("Time", "0.0 s", disabled=True)
        self.play = gui.add_checkbox("Play", False)
        self._on_update(self.frame, self._show_frame)

    def _show_frame(self) -> None:
        with self._lock:
            # Frames may be missing from a chunk: the last one before is shown.
            frames = np.asarray(self.drawing.viewed.frames)
            row = max(int(np.searchsorted(frames, self.frame.value, side="right")) - 1, 0)
            with self._client.atomic():
                self.drawing.show_row(row)
                self._follow()
            _set_value(self._time, f"{self.drawing.viewed.times_s[row]:.1f} s")
            if not self.play.value:
                self._playing_s = float(self.drawing.viewed.times_s[row])

    def _add_drive(self, viewed: ViewedChunk) -> None:
        gui = self._client.gui
        # Without an image there is no camera to drive along with, and nothing to show.
        self._drive_folder = gui.add_folder("Drive along", visible=bool(viewed.images))
        with self._drive_folder:
            hint = "The camera follows the recorded path; frusta are hidden."
            self.drive = gui.add_checkbox("Drive along", False, hint=hint)
            self.offset = gui.add_slider("Metres to the left", -MAX_OFFSET_M, MAX_OFFSET_M, 0.25, 0.0)
            self.camera = gui.add_dropdown("Camera", viewed.camera_names or (_NO_CAMERA,))
            self._image = gui.add_image(viewed.images[0].pixels if viewed.images else _NO_PIXELS, label="Recorded")
        for control in (self.drive, self.offset, self.camera):
            self._on_update(control, self._change_drive)

    def _change_drive(self) -> None:
        with self._lock:
            if self.drive.value:
                self.drawing.show_frusta("none")
            else:
                self.drawing.show_frusta(self._frusta.value)
                self._client.camera.up_direction = (0.0, 0.0, 1.0)
            with self._client.atomic():
                self._follow()

    def _follow(self) -> None:
        image = self._find_image()
        if image is None:
            return
        self._image.image = image.pixels
        if not self.drive.value:
            return
        viewed = self.drawing.viewed
        ego = viewed.chunk_SE3_ego[self.drawing.row]
        # Images may be there at some frames alone: the camera keeps its place on the vehicle between them.
        taken = viewed.chunk_SE3_ego[viewed.frames.index(image.frame)]
        pose = shift_laterally(ego @ np.linalg.inv(taken) @ image.chunk_SE3_camera, ego, self.offset.value)
        camera = self._client.camera
        camera.fov = image.fov_rad
        camera.position = pose[:3, 3]
        camera.look_at = pose[:3, 3] + _LOOK_AHEAD_M * pose[:3, 2]
        camera.up_direction = -pose[:3, 1]

    def _find_image(self) -> CameraImage | None:
        viewed = self.drawing.viewed
        frame = viewed.frames[self.drawing.row]
        images = [image for image in viewed.images if image.camera == self.camera.value]
        return min(images, key=lambda image: (abs(image.frame - frame), image.frame), default=None)

    def _add_visibility(self, viewed: ViewedChunk) -> None:
        gui = self._client.gui
        with gui.add_folder("Show"):
            self._frusta = gui.add_dropdown("Cameras", FRUSTA)
            self._add_switch("recorded path", lambda is_on: setattr(self.drawing.path, "visible", is_on))
            if self._with_range:
                self._add_switch("reliable range", self._show_range)
            self._range_note = gui.add_markdown(_RANGE_WAITS if self._with_range else "")
            for node in viewed.scene.nodes:
                if node.motion is None:
                    self._add_node_switch(node.name)
        self._on_update(self._frusta, self._change_drive)
        if viewed.actor_names:
            with gui.add_folder("Actors", expand_by_default=False):
                for name in viewed.actor_names:
                    self._add_node_switch(name)

    def _show_range(self, is_visible: bool) -> None:
        if self.drawing.range_lines is not None:
            self.drawing.range_lines.visible = is_visible

    def _add_node_switch(self, name: str) -> None:
        self._add_switch(name, lambda is_on: self.drawing.hide(name, not is_on))

    def _add_switch(self, name: str, change: Callable[[bool], None]) -> None:
        switch = self._client.gui.add_checkbox(name, True)
        self._switches[name] = switch
        self._changes[name] = change

        def act() -> None:
            with self._lock:
                change(switch.value)

        self._on_update(switch, act)

    def _on_update(self, control: Any, action: Callable[[], None]) -> None:
        @control.on_update
        def _(event: object) -> None:
            try:
                action()
            except (GenreError, OSError) as error:
                self._client.add_notification("This cannot be shown", str(error), color="red")


def _describe_chunk(viewed: ViewedChunk) -> str:
    # Two spaces end a line in Markdown.
    return "  \n".join([f"**{_escape_markdown(viewed.log)}**", *map(_escape_markdown, viewed.scene.losses)])


def _escape_markdown(text: str) -> str:
    # The browser runs HTML in Markdown, and a log's name is any folder's. A backslash makes punctuation plain.
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)


def _needs_new_controls(before: ViewedChunk, after: ViewedChunk) -> bool:
    # Controls that stay keep their folders open, too.
    return before.number != after.number or [n.name for n in before.scene.nodes] != [n.name for n in after.scene.nodes]


def _accepts(control: Any, value: Any) -> bool:
    # Another chunk has other frames, and may have other cameras.
    if isinstance(control, viser.GuiSliderHandle):
        return bool(control.min <= value <= control.max)
    return not isinstance(control, viser.GuiDropdownHandle) or value in control.options


def _set_value(control: Any, value: object) -> None:
    # viser's setter is not in its types. The control's callbacks run at once, in this thread.
    control.value = value
