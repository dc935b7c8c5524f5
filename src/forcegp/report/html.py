"""Pages as single HTML files: templates, style and figures in one, nothing to be fetched."""

from __future__ import annotations

from dataclasses import dataclass

import jinja2

from forcegp.report.style import Picture


@dataclass(frozen=True)
class FigureBlock:
    """Pictures under one heading and caption.

    Attributes:
        heading: what it is, with the paper's figure number where it has one.
        caption: what is seen.
        pictures: the panels.
        source: file with the data.
    """

    heading: str
    caption: str
    pictures: tuple[Picture, ...]
    source: str


def render(template: str, **values: object) -> str:
    """A template of this package with its values; a value that is missing is an error."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("forcegp.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
