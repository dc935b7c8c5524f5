"""What notebooks show: true numbers, and no markup from files."""

from __future__ import annotations

import dataclasses
import sys
import types
from html.parser import HTMLParser

import pytest

import forcegp
from forcegp.notebook import FitBar, html_table
from forces.cases import logged, two_contacts
from logs import random_log

HOSTILE = "<script>alert(1)</script>\"'&"


class Tags(HTMLParser):
    """Tags and text of a document."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.words: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)

    def handle_data(self, data: str) -> None:
        self.words.append(data)


KNOWN = {"div", "p", "b", "table", "thead", "tbody", "tr", "th", "td"}


def test_every_text_is_escaped() -> None:
    found = Tags(html_table(HOSTILE, (HOSTILE,), [(HOSTILE,)], [HOSTILE]))
    assert found.tags <= KNOWN
    assert found.words.count(HOSTILE) == 4


def test_names_of_a_robot_file_are_text() -> None:
    robot = forcegp.load_robot("double_pendulum")
    robot = dataclasses.replace(robot, name=HOSTILE, joint_names=(HOSTILE, "elbow"), remarks=(HOSTILE,))
    contact = forcegp.SurfaceContact(HOSTILE, robot.frame_names[-1], (0, 0, 0), forcegp.Plane())
    system = forcegp.ConstrainedSystem(robot, [contact])
    data = random_log(20, joints=(HOSTILE, "elbow"))
    shown = [robot, system, data, forcegp.StructuredGP(system, "zero"), forcegp.models.IndependentGP(system)]
    for one in shown:
        found = Tags(one._repr_html_())
        assert found.tags <= KNOWN
        assert any(HOSTILE in word for word in found.words), "the name is shown"


def test_a_fit_says_how_it_went() -> None:
    model = forcegp.StructuredGP(two_contacts(), "analytical", noise=0.1)
    assert repr(model) == "<StructuredGP of 'kuka_iiwa': 7 joints, contact table, ball>"
    fit = model.fit(logged(two_contacts(), 8), learn=[])
    assert repr(fit) == (
        "<StructuredFit of 'kuka_iiwa': 7 joints, contact table, ball; conditioned, nothing learned>"
    )
    words = Tags(fit._repr_html_()).words
    assert words[words.index("training samples") + 1] == "8"
    assert words[words.index("noise of qdd") + 1].startswith("0.1, 0.1")
    assert words[words.index("log marginal likelihood") + 1] == f"{fit.result.log_marginal_likelihood:.4g}"
    for one in (fit, fit.predict(*(x[:2] for x in (fit.training.measurements[0].states[:3])))):
        assert len(repr(one)) < 200, "no tensors are printed"


def test_a_fit_shows_its_progress_in_a_notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    """One output is displayed and then updated, by the protocol of IPython."""
    outputs: list[list[str]] = []

    class Handle:
        def update(self, content: dict[str, str], raw: bool) -> None:
            assert raw
            outputs[-1].append(content["text/html"])

    def display(content: dict[str, str], raw: bool, display_id: bool) -> Handle:
        assert raw and display_id
        outputs.append([content["text/html"]])
        return Handle()

    shell = types.SimpleNamespace(get_ipython=object, display=types.SimpleNamespace(display=display))
    monkeypatch.setitem(sys.modules, "IPython", shell)
    fit = forcegp.StructuredGP(two_contacts(), "analytical", noise=0.1).fit(
        logged(two_contacts(), 8), progress=FitBar()
    )
    assert len(outputs) == 1
    assert len(outputs[0]) >= fit.result.evaluations > 1
    count = fit.result.evaluations
    assert outputs[0][-1].startswith(
        f'<progress value="{count}" max="{count}"></progress> {count} evaluations, '
    )
