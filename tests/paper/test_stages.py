"""Stages run once, resume after an interruption, and run again when what went into them has changed."""

from __future__ import annotations

from pathlib import Path

import pytest

from forcegp.paper import stages as module
from forcegp.paper.stages import Advance, StageError, Stages, code_digest, stage_key


class Work:
    """Counts how often a stage was really run."""

    def __init__(self, text: str = "result") -> None:
        self.text, self.runs = text, 0

    def __call__(self, folder: Path, advance: Advance) -> None:
        self.runs += 1
        (folder / "a.txt").write_text(self.text)
        advance(1, note="done")


def test_a_stage_runs_once_and_keeps_its_files(tmp_path: Path) -> None:
    work, lines = Work(), []
    first = Stages(tmp_path, say=lines.append).run("group/one", work, settings={"n": 1})
    second = Stages(tmp_path, say=lines.append).run("group/one", work, settings={"n": 1})
    assert work.runs == 1 and len(lines) == 1 and lines[0].startswith("group/one: ")
    assert not first.reused and second.reused and second.seconds == pytest.approx(first.seconds)
    assert (second / "a.txt").read_text() == "result"


def test_changed_settings_run_the_stage_again_and_all_that_follow(tmp_path: Path) -> None:
    one, two, other = Work(), Work(), Work()
    for n in (1, 1, 2):
        stages = Stages(tmp_path)
        before = stages.run("one", one, settings={"n": n})
        stages.run("two", two, settings={}, inputs=[before])
        stages.run("other", other, settings={})
    assert (one.runs, two.runs, other.runs) == (2, 2, 1)


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, ValueError])
def test_an_interrupted_stage_leaves_nothing_and_runs_next_time(
    tmp_path: Path, interruption: type[BaseException]
) -> None:
    first, work = Work("first"), Work("second")

    def breaks(folder: Path, advance: Advance) -> None:
        (folder / "a.txt").write_text("half")
        raise interruption

    stages = Stages(tmp_path)
    stages.run("one", first, settings={})
    with pytest.raises(interruption):
        stages.run("two", breaks, settings={})
    assert [p.name for p in tmp_path.iterdir()] == ["one"]
    resumed = Stages(tmp_path)
    assert resumed.run("one", first, settings={}).reused
    assert (resumed.run("two", work, settings={}) / "a.txt").read_text() == "second"
    assert (first.runs, work.runs) == (1, 1)


def test_a_failed_new_version_keeps_the_old_files(tmp_path: Path) -> None:
    def breaks(folder: Path, advance: Advance) -> None:
        raise ValueError("broken")

    Stages(tmp_path).run("one", Work("old"), settings={"n": 1})
    with pytest.raises(ValueError, match="broken"):
        Stages(tmp_path).run("one", breaks, settings={"n": 2})
    again = Stages(tmp_path).run("one", Work("never"), settings={"n": 1})
    assert again.reused and (again / "a.txt").read_text() == "old"


@pytest.mark.parametrize("damage", ["{", "", '{"format": "forcegp-stage", "version": 99}'])
def test_a_damaged_stage_is_run_again(tmp_path: Path, damage: str) -> None:
    work = Work()
    stage = Stages(tmp_path).run("one", work, settings={})
    (stage / "stage.json").write_text(damage)
    assert not Stages(tmp_path).run("one", work, settings={}).reused
    assert work.runs == 2


def test_the_key_tells_name_settings_and_inputs_apart_but_not_their_order() -> None:
    assert stage_key("a", {"x": 1, "y": 2}, []) == stage_key("a", {"y": 2, "x": 1}, [])
    keys = {stage_key(name, {"x": x}, []) for name in "ab" for x in (1, 1.5, "1", None)}
    assert len(keys) == 8


def test_one_name_with_two_meanings_is_an_error(tmp_path: Path) -> None:
    stages = Stages(tmp_path)
    stages.run("one", Work(), settings={"n": 1})
    with pytest.raises(StageError, match="'one' was requested twice"):
        stages.run("one", Work(), settings={"n": 2})


def test_progress_is_opened_with_name_and_total_and_told_the_note(tmp_path: Path) -> None:
    from contextlib import contextmanager

    told: list[object] = []

    @contextmanager
    def progress(description: str, total: int):
        told.append((description, total))
        yield lambda done, total=None, note="": told.append((done, note))

    Stages(tmp_path, progress).run("one", Work(), settings={}, total=5)
    assert told == [("one", 5), (1, "done")]


def package(root: Path, text: str = "x = 1") -> Path:
    """A package with a module, a template and a command."""
    for name, content in (("a.py", text), ("cli/b.py", "y = 2"), ("__pycache__/a.pyc", "z")):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(content)
    return root


def test_the_digest_follows_the_sources_but_not_caches_and_commands(tmp_path: Path) -> None:
    digests = [code_digest(package(tmp_path / name)) for name in "ab"]
    assert digests[0] == digests[1]
    assert code_digest(package(tmp_path / "c", "x = 2")) != digests[0]
    for ignored in ("cli/b.py", "__pycache__/a.pyc"):
        changed = package(tmp_path / ignored.replace("/", "-"))
        (changed / ignored).write_text("changed")
        assert code_digest(changed) == digests[0]
    renamed = package(tmp_path / "d")
    (renamed / "a.py").rename(renamed / "e.py")
    assert code_digest(renamed) != digests[0]


def test_results_of_other_code_are_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work = Work()
    for text, runs in (("x = 1", 1), ("x = 1", 1), ("x = 2", 2)):
        monkeypatch.setattr(module, "PACKAGE", package(tmp_path / text.replace(" ", ""), text))
        Stages(tmp_path / "out").run("one", work, settings={})
        assert work.runs == runs
