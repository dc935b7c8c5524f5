"""Animations of the arm, which are drawn by a script embedded in the page."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files

import torch
from markupsafe import Markup
from torch import Tensor

from forcegp import kinematics
from forcegp.robot.model import BASE, RobotModel

FRAMES_PER_SECOND = 20
"""Frame rate of animations [1/s]."""


def animation(content: Mapping[str, object], label: str) -> Markup:
    """Return a canvas with a slider, a play button and a checkbox for each arm.

    Args:
        content: input to `templates/animation.js`. `times` are the times of the frames [s], and `bodies` is
            the number of points per arm. `films` are the arms, with `label`, `colour`, `dash` and flattened
            `points` (frames, bodies, 3) [m]. The other keys are optional. Convex `solids` have `colour`,
            `opacity`, flattened `points` [m] and `link`, their column in `poses` (frames, links, 12). `paths`
            have `colour`, `width` and `points`. `forces` have `start`, `tip` and `bar` in each frame, and
            `texts` has one text per frame.
        label: text alternative for the canvas.
    """
    # "</" would end the script element, even within a string.
    text = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    return Markup(
        '<figure class="animation"><canvas width="920" height="560" role="img" '
        f'aria-label="{label}"></canvas>'
        '<p><button type="button">Play</button> <input type="range" min="0" value="0" step="1" '
        'aria-label="time"> <output></output></p><p class="films"></p>'
        f'<script type="application/json">{text}</script><script>{_script()}</script></figure>'
    )


def animation_source() -> str:
    """Return the hash of the animation script, for use in a content security policy."""
    digest = hashlib.sha256(_script().encode()).digest()
    return "sha256-" + base64.b64encode(digest).decode()


def _script() -> str:
    return (files("forcegp.report") / "templates" / "animation.js").read_text(encoding="utf-8")


def arm_points(robot: RobotModel, q: Tensor, frame: str, point: Sequence[float]) -> Tensor:
    """Return the base, the link origins along the chain, and the tip, `(frames, points, 3)` [m].

    A free base is where its last joint is.
    """
    poses = kinematics.link_poses(robot, q)
    joint = robot.frame_parents[robot.frame_index(frame)]
    chain: list[int] = []
    while joint != BASE:
        chain.insert(0, joint)
        joint = robot.parents[joint]
    moved = [joint for joint in chain if robot.driven[joint]]
    first = chain[: len(chain) - len(moved)][-1:]
    origins = poses.position[:, first + moved] + robot.base_position
    base = robot.base_position.expand(len(q), 0 if first else 1, 3)
    tip = kinematics.point_position(robot, q, frame, tuple(point))[:, None]
    return torch.cat([base, origins, tip], dim=1)


def rounded(points: Tensor) -> list[float]:
    """Return points as a flat list of coordinates [m], rounded to 10 µm."""
    return [round(x, 5) for x in points.detach().flatten().tolist()]
