"""The view as one self-contained HTML file, or live in a browser."""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from forcegp.files import write_text
from forcegp.optional import optional_module
from forcegp.view.motion import Motion
from forcegp.view.shapes import Shape
from forcegp.view.stage import Stage

LOCAL = "127.0.0.1"
"""The view is served to this computer only."""
PORT = 8080


def write_view(path: str | Path, motion: Motion, shapes: Sequence[Shape], title: str = "forcegp") -> Path:
    """Write a motion as one HTML file that needs no other and no network.

    Args:
        path: where it goes.
        motion: what to show.
        shapes: what the robot looks like.
        title: of the page.

    Returns:
        The path.

    Raises:
        MissingDependencyError: viser is not installed.
    """
    # viser prints its address even if it is asked not to.
    with contextlib.redirect_stdout(io.StringIO()):
        server = _server(PORT)
        try:
            stage = Stage(server, motion, shapes)
            stage.show(0)
            recording = server.get_scene_serializer()
            for k in range(1, len(motion.t)):
                recording.insert_sleep(float(motion.t[k] - motion.t[k - 1]))
                stage.show(k)
            html = recording.as_html()
        finally:
            server.stop()
    write_text(Path(path), _titled(html, title))
    return Path(path)


def _titled(html: str, title: str) -> str:
    before, _, rest = html.partition("<title>")
    _, _, after = rest.partition("</title>")
    return f"{before}<title>{escape(title)}</title>{after}" if after else html


def serve(
    motion: Motion,
    shapes: Sequence[Shape],
    port: int = PORT,
    say: Callable[[str], None] = print,
    running: Callable[[], bool] = lambda: True,
) -> None:
    """Show a motion in a browser on this computer until interrupted, with a slider for the time.

    Args:
        motion: what to show.
        shapes: what the robot looks like.
        port: of the server; the next free one is taken.
        say: called with the address.
        running: asked before each picture whether to go on.

    Raises:
        MissingDependencyError: viser is not installed.
    """
    server = _server(port)
    try:
        stage = Stage(server, motion, shapes)
        last = len(motion.t) - 1
        slider = server.gui.add_slider("picture", min=0, max=max(last, 1), step=1, initial_value=0)
        playing = server.gui.add_checkbox("play", last > 0)
        say(f"http://{LOCAL}:{server.get_port()}")
        shown = -1
        while running():
            k = min(int(slider.value), last)
            if k != shown:
                stage.show(k)
                shown = k
            step = float(motion.t[k] - motion.t[k - 1]) if k else 0.05
            time.sleep(min(max(step, 0.01), 0.2))
            if playing.value and last:
                slider.value = 0 if k == last else k + 1
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()


def _server(port: int) -> Any:
    viser = optional_module("viser", "The 3D view", "view")
    return viser.ViserServer(host=LOCAL, port=port, verbose=False)
