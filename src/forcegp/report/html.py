"""Pages as single HTML files: templates, style and plots in one file that fetches nothing."""

from __future__ import annotations

from dataclasses import dataclass

import jinja2

from forcegp.report.style import Picture


@dataclass(frozen=True)
class Block:
    """Pictures under one heading and caption.

    Attributes:
        heading: the title, with the paper's figure number if it has one.
        caption: what the pictures show.
        pictures: the panels.
        source: file with the data.
    """

    heading: str
    caption: str
    pictures: tuple[Picture, ...]
    source: str


@dataclass(frozen=True)
class Finding:
    """A sentence computed from results.

    Attributes:
        topic: a few words.
        agrees: whether the claim holds; `None` if none is made.
        text: the sentence, with its numbers.
        words: verdict on a claim that holds, and on one that does not.
    """

    topic: str
    agrees: bool | None
    text: str
    words: tuple[str, str] = ("confirmed", "differs")

    @property
    def verdict(self) -> str | None:
        """The verdict, or `None` if no claim is made."""
        return None if self.agrees is None else self.words[0 if self.agrees else 1]


def render(template: str, package: str = "forcegp.report", **values: object) -> str:
    """Fill in a template; a missing value is an error.

    Args:
        template: file name under `templates/` of the package, or of this one.
        package: where to look first.
        values: what the template refers to.
    """
    packages = dict.fromkeys((package, "forcegp.report"))
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(name) for name in packages]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
