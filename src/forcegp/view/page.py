"""The 3D view, written as a self-contained HTML file or served to a browser on this computer."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import torch

from forcegp import kinematics
from forcegp.constraints import Cylinder, Plane, Sphere, SurfaceContact
from forcegp.constraints.surface import Surface
from forcegp.files import write_text
from forcegp.report.animation import animation, animation_source, arm_points, rounded
from forcegp.report.page import INK, render
from forcegp.robot.shapes import Array, Shape, box, cylinder, sphere, turn_z
from forcegp.rollout.comparison import tip_of
from forcegp.view.motion import LOGGED, MEAN, Force, Motion

ROBOT, BASE_COLOUR, SURFACE = "#607d96", "#464e56", "#e2cd96"
OPACITY = 0.45
"""Opacity of the solids, which keeps a force drawn inside the tool visible."""
PATHS = {LOGGED: ("#222222", 2.0), MEAN: ("#0072b2", 2.0)}
SAMPLED = ("#82b9dc", 1.0)
ARROW = 0.3
"""Length of the longest arrow [m]."""
MARGIN = 0.15
"""Distance by which a drawn surface extends beyond the path of the tip [m]."""
TILE, TILES, PROJECTIONS = 0.04, 60, 3
"""Side [m] and number of the tiles that show a surface without a simple shape, and Newton steps onto it."""
LOCAL, PORT = "127.0.0.1", 8080
"""Address of the server, which is accessible only from this computer."""


def content_of(motion: Motion, shapes: Sequence[Shape]) -> dict[str, Any]:
    """Return a motion as input to `report.animation`: the robot, surfaces, paths, and labelled forces."""
    system, frames = motion.system, range(len(motion.t))
    robot, poses = system.robot, kinematics.link_poses(system.robot, motion.q)
    R = torch.cat([robot.base_rotation.expand(len(frames), 1, 3, 3), poses.rotation], dim=1)
    p = torch.cat([torch.zeros_like(poses.position[:, :1]), poses.position], dim=1) + robot.base_position
    arm = arm_points(robot, motion.q, *tip_of(system))
    solids = [solid(x.points, ROBOT if x.link >= 0 else BASE_COLOUR, x.link + 1) for x in shapes]
    for contact in system.contacts:
        if isinstance(contact, SurfaceContact):
            around = _around(motion, contact.name, arm[:, -1].detach().cpu().numpy())
            solids += (solid(part, SURFACE, None) for part in _patches(contact.surface, around))
    largest = max((float(np.nanmax(abs(f.value), initial=0.0)) for f in motion.forces), default=0.0)
    return {
        "times": motion.t.tolist(),
        "bodies": arm.shape[1],
        "films": [{"label": robot.name, "colour": INK, "dash": [], "points": rounded(arm)}],
        "solids": [each for each in solids if each["points"]],
        "poses": [[rounded(x) for x in frame] for frame in torch.cat([R.flatten(-2), p], dim=-1)],
        "paths": [
            dict(zip(("colour", "width"), PATHS.get(path.kind, SAMPLED), strict=True))
            | {"points": rounded(torch.from_numpy(path.points))}
            for path in motion.paths
        ],
        "forces": [_arrow(force, ARROW / largest) for force in motion.forces if largest > 0.0],
        "texts": [[force_text(force, k) for force in motion.forces] for k in frames],
    }


def solid(points: Array, colour: str, link: int | None) -> dict[str, Any]:
    """Return a convex solid for an animation, with its corners given in the frame of a link or the world."""
    style = {"colour": colour, "opacity": OPACITY, "link": link}
    return {"points": rounded(torch.from_numpy(points)), **style}


def _around(motion: Motion, contact: str, tip: Array) -> Array:
    """Return the points that a drawn surface must cover."""
    positions = [force.point for force in motion.forces if force.contact == contact]
    points = np.concatenate(positions or [path.points for path in motion.paths] or [tip])
    return points if len(points) else tip


def _patches(surface: Surface, points: Array) -> list[Array]:
    """Return the corners of a planar patch below the points, a sphere, a cylinder along the points, or tiles
    on another surface near the points."""
    if isinstance(surface, Plane):
        R = turn_z(np.asarray(surface.normal))
        local = points @ R
        low, high = local.min(axis=0) - MARGIN, local.max(axis=0) + MARGIN
        middle = 0.5 * (low + high)
        middle[2] = surface.offset - 0.005
        return [(box(high[0] - low[0], high[1] - low[1], 0.01) + middle) @ R.T]
    if isinstance(surface, Sphere):
        return [sphere(surface.radius) + np.asarray(surface.center)]
    if isinstance(surface, Cylinder):
        axis, centre = np.asarray(surface.axis), np.asarray(surface.center)
        along = (points - centre) @ axis
        length = float(along.max() - along.min()) + 2.0 * MARGIN
        middle = centre + 0.5 * float(along.max() + along.min()) * axis
        return [cylinder(surface.radius, length, 48) @ turn_z(axis).T + middle]
    p = torch.from_numpy(points[np.linspace(0, len(points) - 1, TILES).astype(int)])
    for _ in range(PROJECTIONS):
        # p − c ∇c/|∇c|²
        slope = surface.gradient(p)
        p = p - surface.value(p)[:, None] * slope / slope.square().sum(-1, keepdim=True)
    normals = torch.nn.functional.normalize(surface.gradient(p), dim=-1).numpy()
    tile = box(TILE, TILE, 0.1 * TILE)
    return [tile @ turn_z(n).T + at for n, at in zip(normals, p.numpy(), strict=True)]


def _arrow(force: Force, scale: float) -> dict[str, Any]:
    """Return the arrow of a force in each frame and its ±2σ segment, or `None` while the contact is open."""
    along = scale * force.normal
    tip, bar = force.point + force.value[:, None] * along, 2.0 * force.std[:, None] * along
    closed = np.isfinite(force.value)

    def listed(values: Array) -> list[Any]:
        return [x.round(5).tolist() if shut else None for x, shut in zip(values, closed, strict=True)]

    ends = np.stack([tip - bar, tip + bar], axis=1)
    return {"start": listed(force.point), "tip": listed(tip), "bar": listed(ends)}


def force_text(force: Force, k: int) -> str:
    """Describe a force in words."""
    value, std = force.value[k], force.std[k]
    if not np.isfinite(value):
        return f"{force.contact}: open"
    return f"{force.contact}: {value:.1f}" + (f" ± {2.0 * std:.2g} N" if std > 0.0 else " N")


def view_page(motion: Motion, shapes: Sequence[Shape], title: str) -> str:
    """Return a motion as self-contained HTML."""
    label = "The robot in motion, with its surfaces, contact forces and paths of the tip"
    drawn = animation(content_of(motion, shapes), label)
    return render("view.html.j2", title=title, animation=drawn, script=animation_source())


def write_view(path: str | Path, motion: Motion, shapes: Sequence[Shape], title: str = "forcegp") -> Path:
    """Write a motion as a single self-contained HTML file."""
    write_text(path, view_page(motion, shapes, title))
    return Path(path)


def serve(page: str, port: int = PORT, say: Callable[[str], None] = print) -> None:
    """Serve a page to a browser on this computer until interrupted. `say` is called with its address.

    Other users of the computer cannot guess the address. Requests that name other hosts are rejected.
    """
    path = f"/{secrets.token_urlsafe(16)}"

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            host = self.headers.get("Host", "").rpartition(":")[0]
            known = host in (LOCAL, "localhost") and secrets.compare_digest(self.path.encode(), path.encode())
            self.send_response(200 if known else 404)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(page.encode() if known else b"")

        def log_message(self, format: str, *args: object) -> None:
            pass

    try:
        server = ThreadingHTTPServer((LOCAL, port), Handler)
    except OSError:
        server = ThreadingHTTPServer((LOCAL, 0), Handler)
    with server, suppress(KeyboardInterrupt):
        say(f"http://{LOCAL}:{server.server_port}{path}")
        server.serve_forever()
