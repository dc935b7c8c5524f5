"""The arm in motion: an animation in the page, drawn by its own script."""

from __future__ import annotations

import base64
import hashlib
import json
from importlib.resources import files

from markupsafe import Markup

from forcegp.report.rollout_data import RolloutData
from forcegp.report.style import DASHES, INK, colour, label


def animation(data: RolloutData) -> Markup:
    """The arm in motion: a canvas with a slider, a play button and a checkbox for each model."""
    films = [
        {
            "label": "simulated" if film.label == "logged" else label(film.label),
            "colour": INK if film.label == "logged" else colour(film.label),
            "dash": [3.0 * length for length in DASHES.get(film.label, ())],
            "points": film.points,
        }
        for film in data.films
    ]
    content = {"times": data.frame_times, "bodies": data.bodies, "films": films}
    # "</" would end the script element, even inside a string.
    text = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    return Markup(
        '<figure class="animation"><canvas width="920" height="560" role="img" '
        'aria-label="The arm moving: simulated in black, predicted in colour"></canvas>'
        '<p><button type="button">Play</button> <input type="range" min="0" value="0" step="1" '
        'aria-label="time"> <output></output></p><p class="films"></p>'
        f'<script type="application/json">{text}</script><script>{_script()}</script></figure>'
    )


def animation_source() -> str:
    """Hash of the animation's script for a content security policy."""
    digest = hashlib.sha256(_script().encode()).digest()
    return "sha256-" + base64.b64encode(digest).decode()


def _script() -> str:
    return (files("forcegp.report") / "templates" / "animation.js").read_text(encoding="utf-8")
