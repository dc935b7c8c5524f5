"""The view as one self-contained HTML file, or live in a browser.

The nodes of the viser scene are made once, and moved from picture to picture.
"""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from forcegp import kinematics
from forcegp.constraints import Cylinder, Plane, Sphere, SurfaceContact
from forcegp.constraints.surface import Surface
from forcegp.errors import optional_module
from forcegp.files import write_text
from forcegp.robot.model import BASE
from forcegp.view.motion import LOGGED, MEAN, Force, Motion
from forcegp.view.shapes import Array, Shape, turn_z

ROBOT, BASE_COLOUR, SURFACE = (96, 125, 150), (70, 78, 86), (226, 205, 150)
FLOOR = (205, 210, 214)
OPACITY = 0.55
"""Of the links, so that a force inside the tool is seen."""
FORCE, SPREAD = (200, 30, 45), (245, 150, 120)
PATHS = {LOGGED: ((34, 34, 34), 3.0), MEAN: ((0, 114, 178), 3.0)}
SAMPLED = ((130, 185, 220), 1.5)
ARROW = 0.3
"""Length of the longest arrow [m]."""
MARGIN = 0.15
"""By how much a surface is drawn beyond the path of the tip [m]."""


class Stage:
    """Robot, surfaces, forces and paths on a viser server.

    Args:
        server: a `viser.ViserServer`.
        motion: what to show.
        shapes: what the robot looks like.
    """

    def __init__(self, server: Any, motion: Motion, shapes: Sequence[Shape]) -> None:
        self.motion, self._scene = motion, server.scene
        self._scene.set_up_direction("+z")
        # Shadows and reflections cost most of the time where a browser renders without a graphics card.
        self._scene.configure_environment_map(None)
        self._scene.configure_default_lights(cast_shadow=False)
        self._scene.add_light_ambient("/light", intensity=2.5)
        self._add_floor()
        self._place_camera(server)
        robot = motion.system.robot
        poses = kinematics.link_poses(robot, motion.q)
        self._position = (poses.position + robot.base_position).detach().cpu().numpy()
        self._turn = quaternions(poses.rotation.detach().cpu().numpy())
        self._links = {i: self._scene.add_frame(f"/robot/{i}", show_axes=False) for i in range(robot.nq)}
        base = self._scene.add_frame("/robot/base", show_axes=False)
        base.position = robot.base_position.cpu().numpy()
        base.wxyz = quaternions(robot.base_rotation.cpu().numpy()[None])[0]
        for number, shape in enumerate(shapes):
            self._add_shape(number, shape)
        for contact in motion.system.contacts:
            if isinstance(contact, SurfaceContact):
                self._add_surface(contact.name, contact.surface, self._around(contact.name))
        self._add_paths()
        values = [abs(force.value[np.isfinite(force.value)]) for force in motion.forces]
        largest = max((float(x.max()) for x in values if len(x)), default=0.0)
        self._scale = ARROW / largest if largest > 0.0 else 0.0
        self._arrows = [self._add_arrow(force) for force in motion.forces] if self._scale else []
        self._label = self._scene.add_label("/time", "", position=self._label_place(), anchor="bottom-center")

    def show(self, k: int) -> None:
        """Move everything to picture k."""
        for i, node in self._links.items():
            node.position, node.wxyz = self._position[k, i], self._turn[k, i]
        words = [f"t = {self.motion.t[k]:.2f} s"]
        for force, (arrow, spread) in zip(self.motion.forces, self._arrows, strict=False):
            closed = bool(np.isfinite(force.value[k]))
            arrow.visible, spread.visible = closed, closed and bool(force.std[k] > 0.0)
            if closed:
                arrow.points, spread.points = self._arrow(force, k)
            words.append(force_text(force, k))
        self._label.text = "   ".join(words)

    def _add_floor(self) -> None:
        """Lines on the floor, half a metre apart."""
        marks = np.linspace(-1.5, 1.5, 7)
        along = [[[x, -1.5, 0.0], [x, 1.5, 0.0]] for x in marks]
        across = [[[-1.5, y, 0.0], [1.5, y, 0.0]] for y in marks]
        self._scene.add_line_segments(
            "/floor", np.array(along + across), FLOOR, thickness=1.0, thickness_units="screen"
        )

    def _place_camera(self, server: Any) -> None:
        """Look at the middle of what moves, from far enough to see the arm."""
        points = np.concatenate([path.points for path in self.motion.paths] or [np.zeros((1, 3))])
        base = self.motion.system.robot.base_position.cpu().numpy()
        middle = 0.5 * (points.mean(axis=0) + base) + [0.0, 0.0, 0.15]
        reach = max(0.6, 1.1 * float(np.linalg.norm(points - base, axis=1).max()))
        server.initial_camera.look_at = tuple(middle)
        server.initial_camera.position = tuple(middle + reach * np.array([0.9, -1.1, 0.6]))

    def _add_shape(self, number: int, shape: Shape) -> None:
        parent = "base" if shape.link == BASE else str(shape.link)
        name = f"/robot/{parent}/{number}"
        place: dict[str, Any] = {"position": shape.position, "wxyz": quaternions(shape.rotation[None])[0]}
        place["opacity"] = 1.0 if shape.link == BASE else OPACITY
        colour = BASE_COLOUR if shape.link == BASE else ROBOT
        if shape.kind == "box":
            self._scene.add_box(name, color=colour, dimensions=shape.size, **place)
        elif shape.kind == "cylinder":
            radius, length = shape.size
            self._scene.add_cylinder(name, radius, length, color=colour, **place)
        elif shape.kind == "sphere":
            self._scene.add_icosphere(name, shape.size[0], color=colour, **place)
        else:
            trimesh = optional_module("trimesh", "A mesh", "view")
            mesh = trimesh.load(str(shape.mesh), force="mesh")
            vertices = np.asarray(mesh.vertices) * shape.size
            self._scene.add_mesh_simple(name, vertices, np.asarray(mesh.faces), color=colour, **place)

    def _around(self, contact: str) -> Array:
        """Points that a surface is drawn around."""
        positions = [force.point for force in self.motion.forces if force.contact == contact]
        paths = [path.points for path in self.motion.paths]
        points = np.concatenate(positions or paths or [np.zeros((0, 3))])
        return points if len(points) else self._position[:, -1]

    def _add_surface(self, name: str, surface: Surface, points: Array) -> None:
        """A patch of a plane below the path, a sphere, or the part of a cylinder along the path."""
        style: dict[str, Any] = {"color": SURFACE, "opacity": 0.55}
        node = f"/surface/{name}"
        if isinstance(surface, Plane):
            R = turn_z(np.asarray(surface.normal))
            local = points @ R
            low, high = local.min(axis=0) - MARGIN, local.max(axis=0) + MARGIN
            middle = 0.5 * (low + high)
            middle[2] = surface.offset - 0.005
            sides = (*(high - low)[:2], 0.01)
            place = {"position": R @ middle, "wxyz": quaternions(R[None])[0]}
            self._scene.add_box(node, dimensions=sides, **style, **place)
        elif isinstance(surface, Sphere):
            self._scene.add_icosphere(
                node, surface.radius, subdivisions=4, position=tuple(surface.center), **style
            )
        elif isinstance(surface, Cylinder):
            axis, centre = np.asarray(surface.axis), np.asarray(surface.center)
            along = (points - centre) @ axis
            length = float(along.max() - along.min()) + 2.0 * MARGIN
            place = {
                "position": centre + 0.5 * float(along.max() + along.min()) * axis,
                "wxyz": quaternions(turn_z(axis)[None])[0],
            }
            self._scene.add_cylinder(node, surface.radius, length, radial_segments=96, **style, **place)

    def _add_paths(self) -> None:
        for number, path in enumerate(self.motion.paths):
            if len(path.points) > 1:
                colour, width = PATHS.get(path.kind, SAMPLED)
                pairs = np.stack([path.points[:-1], path.points[1:]], axis=1)
                self._scene.add_line_segments(
                    f"/path/{path.kind}/{number}", pairs, colour, thickness=width, thickness_units="screen"
                )

    def _add_arrow(self, force: Force) -> tuple[Any, Any]:
        """The arrow of a force, and the segment of ±2 standard deviations about its tip."""
        nothing = np.zeros((1, 2, 3))
        arrow = self._scene.add_arrows(
            f"/force/{force.contact}", nothing, FORCE, shaft_radius=0.008, head_radius=0.02, head_length=0.04
        )
        spread = self._scene.add_line_segments(
            f"/force/{force.contact}_2sigma", nothing, SPREAD, thickness=9.0, thickness_units="screen"
        )
        return arrow, spread

    def _arrow(self, force: Force, k: int) -> tuple[Array, Array]:
        start, along = force.point[k], self._scale * force.normal[k]
        tip = start + force.value[k] * along
        bar = 2.0 * force.std[k] * along
        return np.stack([start, tip])[None], np.stack([tip - bar, tip + bar])[None]

    def _label_place(self) -> Array:
        return np.append(self._position[:, :, :2].mean(axis=(0, 1)), self._position[:, :, 2].max() + 0.25)


def force_text(force: Force, k: int) -> str:
    """A force in words."""
    value, std = force.value[k], force.std[k]
    if not np.isfinite(value):
        return f"{force.contact}: open"
    return f"{force.contact}: {value:.1f}" + (f" ± {2.0 * std:.2g} N" if std > 0.0 else " N")


def quaternions(rotations: Array) -> NDArray[np.float64]:
    """Rotations `(*batch, 3, 3)` as quaternions `(*batch, 4)`, the real part first."""
    xyzw = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat()
    return np.roll(xyzw, 1, axis=-1).reshape(*rotations.shape[:-2], 4)


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
