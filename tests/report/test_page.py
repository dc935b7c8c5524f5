"""The style of the pages that commands write."""

from __future__ import annotations

import re
from importlib.resources import files


def test_pages_follow_the_dark_scheme() -> None:
    style = (files("forcegp.report") / "templates" / "style.css").read_text(encoding="utf-8")
    light, dark = re.findall(r":root \{(.*?)\}", style, flags=re.S)
    names = set(re.findall(r"(--[a-z]+):", light))
    assert names == set(re.findall(r"(--[a-z]+):", dark))
    # No colour outside the two lists, but for the paper of plots, which have dark lines in both schemes.
    rest = (
        style.replace(light, "").replace(dark, "").replace("img, canvas, .films label { background: #fff", "")
    )
    assert not re.findall(r"#[0-9a-fA-F]{3,6}\b(?=[;\s])", rest)
    assert set(re.findall(r"var\((--[a-z]+)\)", rest)) == names
