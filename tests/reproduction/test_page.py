"""The page is one file: nothing is fetched, nothing fails in a browser, and it fits a narrow screen."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest

from report_samples import figures, results
from reproduction.page import render_page

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chromium-browser")
QUIET = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-extensions", "--disable-default-apps",
    "--host-resolver-rules=MAP * ~NOTFOUND",
)  # fmt: skip
NARROW = 400
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


class References(HTMLParser):
    """Collects what a page refers to, its images without text, and its tags."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.undescribed = 0
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        given = dict(attrs)
        self.addresses += [given[name] or "" for name in ("src", "href", "srcset", "data") if name in given]
        self.undescribed += tag == "img" and not given.get("alt")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(render_page(results(), figures()), encoding="utf-8")
    return path


def test_the_page_refers_to_nothing_outside_itself(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    found = References()
    found.feed(text)
    assert found.addresses and all(a.startswith(("data:", "#")) for a in found.addresses)
    assert found.undescribed == 0
    assert not {"iframe", "object", "base"} & set(found.tags)
    style = re.search(r"<style>(.*?)</style>", text, re.S)
    assert style and "url(" not in style.group(1) and "@import" not in style.group(1)


def test_the_page_has_every_figure_of_the_paper_and_every_model(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for heading in (
        "Figure 1",
        "Figure 2",
        "Figure 3",
        "Figure 4",
        "Figure 5",
        "Learning curves",
        "Identification",
        "Trajectories predicted in open loop",
        "The arm in motion",
    ):
        assert heading in text
    for model in ("Analytical model", "Neural network", "S-GP, zero mean", "S-GP, mean and contact prior"):
        assert model in text


def test_the_page_opens_with_pictures_and_a_table_of_a_few_numbers(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    opening = text[text.index("</header>") : text.index("<h2>")]
    assert opening.count("<img") == 2 and opening.count("<table") == 1
    words = re.sub(r"<[^>]*>", " ", re.sub(r"<table.*?</table>", "", opening, flags=re.S)).split()
    assert len(words) < 120


def test_every_claim_at_the_top_links_to_its_finding(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    links = re.findall(r'href="#(finding-\d+)"', text)
    assert links and [text.count(f'id="{link}"') for link in links] == [1] * len(links)


def test_the_policy_lets_the_script_of_the_animation_run_and_no_other(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    scripts = re.findall(r"<script>(.*?)</script>", text, re.S)
    assert len(scripts) == 1
    digest = base64.b64encode(hashlib.sha256(scripts[0].encode()).digest()).decode()
    assert f"{POLICY}; script-src 'sha256-{digest}'\"" in text


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
@pytest.mark.slow
def test_a_browser_shows_the_page_without_complaint(page: Path, tmp_path: Path) -> None:
    # The frame gives the page a narrow screen, plays its animation, and writes down what it measured.
    frame = tmp_path / "frame.html"
    # "</" would end the frame's own script.
    held = json.dumps(page.read_text(encoding="utf-8")).replace("</", "<\\/")
    frame.write_text(
        f'<iframe id="f" style="width:{NARROW}px;height:800px" srcdoc=""></iframe>'
        '<p id="out">waiting</p><script>'
        'const f = document.getElementById("f");'
        "f.onload = () => { const d = f.contentDocument, r = d.documentElement;"
        "const broken = [...d.images].filter(i => !i.complete || i.naturalWidth === 0).length;"
        'const films = d.querySelectorAll(".films input"), play = d.querySelector("button");'
        "films[1].click(); play.click();"
        'document.getElementById("out").textContent ='
        "`measured width=${r.scrollWidth} images=${d.images.length} broken=${broken}`"
        " + ` films=${films.length} shown=${films[1].checked} button=${play.textContent}`; };"
        f"f.srcdoc = {held};</script>",
        encoding="utf-8",
    )
    done = subprocess.run(
        [str(CHROMIUM), *QUIET, f"--user-data-dir={tmp_path / 'profile'}", "--enable-logging=stderr",
         "--virtual-time-budget=5000", "--dump-dom", frame.as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    measured = re.search(r"measured width=(\d+) images=(\d+) broken=(\d+) (.*?)</p>", done.stdout)
    assert measured, done.stdout[-300:]
    width, images, broken = (int(value) for value in measured.groups()[:3])
    assert width <= NARROW and images >= 15 and broken == 0
    assert measured.group(4) == "films=7 shown=false button=Pause"
    # The page's own policy forbids requests, so that an attempt to fetch anything is a console message.
    assert "CONSOLE" not in done.stderr
    assert POLICY in page.read_text(encoding="utf-8")


def test_the_view_is_linked_where_there_is_one() -> None:
    assert '<a href="view.html">' in render_page(results(), figures(), "view.html")
    assert "view.html" not in render_page(results(), figures())
