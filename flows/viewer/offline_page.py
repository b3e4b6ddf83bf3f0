"""One HTML file that plays a chunk's scene in any browser, without a server and without the network."""

from __future__ import annotations

import html
from pathlib import Path

import numpy as np

from flows.simulation.stored_ranges import SideRange
from flows.viewer.chunk_drawing import PATH_RGB, RANGE_RGB, ChunkDrawing
from flows.viewer.local_server import aim_first_view, start_server, stop_server
from flows.viewer.viewed_chunks import ViewedChunk
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import InputError

_LEGEND = """
<div style="position:fixed;left:0.8em;bottom:4em;z-index:5;font:13px/1.5 sans-serif;color:#222;max-width:22em;
background:rgba(255,255,255,0.85);padding:0.5em 0.8em;border-radius:4px;pointer-events:none">{lines}</div>
"""

# The corners of viser's splats have two coordinates, and three.js misses the third where it computes a bounding sphere
# that nothing uses. That one message is left out, so that a reader of the console sees what matters.
_CONSOLE_SCRIPT = """
<script>
(() => {
  const report = console.error.bind(console);
  const harmless = "THREE.BufferGeometry.computeBoundingSphere(): Computed radius is NaN";
  console.error = (...parts) => { if (!String(parts[0]).startsWith(harmless)) report(...parts); };
})();
</script>
"""


def write_offline_page(path: Path, viewed: ViewedChunk, sides: SideRange | None, title: str) -> int:
    """Writes a chunk's scene as one HTML file with a time line.

    Args:
        path: the file to write or replace; its folder is made where it is missing.
        viewed: the chunk.
        sides: the reliable range; ``None``: it is not drawn.
        title: of the page.

    Returns:
        Size of the file in bytes.

    Raises:
        InputError: nothing of the scene is left to show.
        OSError: the file cannot be written.
    """
    if not len(viewed.scene):
        raise InputError("the scene has no Gaussians to show", remedy="Choose another --stage.", chunk=viewed.number)
    page = _add_legend(_record_page(viewed, sides), viewed, sides, title)
    data = page.encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        part.write_bytes(data)
    return len(data)


def _record_page(viewed: ViewedChunk, sides: SideRange | None) -> str:
    # viser records what a server sends; no client ever connects to this one.
    server = start_server("127.0.0.1", 0, "GenRe")
    try:
        drawing = ChunkDrawing.draw(server.scene, viewed)
        if sides is not None:
            drawing.draw_range(server.scene, sides)
        aim_first_view(server, viewed)
        serializer = server.get_scene_serializer()
        # The last frame stays as long as the one before it.
        steps = np.diff(viewed.times_s)
        for row, step_s in enumerate([*steps, steps[-1] if len(steps) else 0.0]):
            drawing.show_row(row)
            serializer.insert_sleep(float(step_s))
        return str(serializer.as_html())
    finally:
        stop_server(server)


def _add_legend(page: str, viewed: ViewedChunk, sides: SideRange | None, title: str) -> str:
    lines = [f"<b>{html.escape(title)}</b>", _describe_line(PATH_RGB, "the recorded path")]
    if sides is not None:
        reach = f"reliable: {sides.left_m:.1f} m to the left, {sides.right_m:.1f} m to the right"
        lines.append(_describe_line(RANGE_RGB, reach))
    lines += [html.escape(loss) for loss in viewed.scene.losses]
    lines.append("Space plays and pauses; drag to turn, right-drag to move, scroll to come nearer.")
    legend = _LEGEND.format(lines="<br>".join(lines))
    page = page.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>", 1)
    page = page.replace("<head>", f"<head>{_CONSOLE_SCRIPT}", 1)
    before, _, after = page.rpartition("</body>")
    return f"{before}{legend}</body>{after}"


def _describe_line(rgb: tuple[int, int, int], words: str) -> str:
    return f'<span style="color:rgb{rgb}">&#9473;&#9473;</span> {words}'
