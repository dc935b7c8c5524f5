"""One folder takes the place of another: at once where the system can, recoverably where it cannot."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

import pytest

from forcegp import exchange as module
from forcegp.errors import DestinationError
from forcegp.exchange import exchange, is_other_than_folder, recover
from forcegp.files import atomic_directory, atomic_file, write_text
from forcegp.temporary import ASIDE, NEW


def folder(path: Path, content: str) -> Path:
    path.mkdir()
    (path / "a").write_text(content)
    (path / "b").write_text(content)
    return path


def write(path: Path, content: str) -> None:
    with atomic_directory(path) as temporary:
        (temporary / "a").write_text(content)
        (temporary / "b").write_text(content)


def content_of(path: Path) -> str:
    a, b = (path / "a").read_text(), (path / "b").read_text()
    assert a == b, "a mixture of two folders"
    return a


@pytest.fixture(params=["exchange", "aside"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both ways of placing a folder."""
    if request.param == "aside":
        monkeypatch.setattr(module, "exchange", lambda a, b: False)
    return request.param


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="renameat2 is Linux's")
def test_two_folders_are_exchanged(tmp_path: Path) -> None:
    a, b = folder(tmp_path / "a", "one"), folder(tmp_path / "b", "two")
    assert exchange(a, b)
    assert (content_of(a), content_of(b)) == ("two", "one")
    with pytest.raises(FileNotFoundError):
        exchange(a, tmp_path / "none")


def test_there_is_a_folder_at_every_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The old folder is at its path until the new one is: seen before and after each step."""
    target, seen = folder(tmp_path / "model", "old"), []
    for name in ("rename", "replace", "unlink", "rmdir"):
        original = getattr(os, name)

        def watched(*args: object, original=original, **options: object) -> object:
            seen.append(content_of(target))
            result = original(*args, **options)
            seen.append(content_of(target))
            return result

        monkeypatch.setattr(os, name, watched)
    write(target, "new")
    assert set(seen) == {"old", "new"}
    assert content_of(target) == "new"


def test_a_folder_moved_aside_by_a_dead_writer_is_recovered(tmp_path: Path) -> None:
    aside = tmp_path / f"{ASIDE}0123456789ab-model"
    folder(aside, "old")
    recover(tmp_path / "model")
    assert content_of(tmp_path / "model") == "old"
    folder(aside, "older")
    recover(tmp_path / "model")
    assert content_of(tmp_path / "model") == "old", "a folder in place is never replaced"
    write(tmp_path / "model", "new")
    assert os.listdir(tmp_path) == ["model"]


def test_litter_of_killed_writers_is_removed_and_work_of_live_ones_is_not(tmp_path: Path) -> None:
    folder(tmp_path / f"{NEW}0123456789ab-model", "half")
    folder(tmp_path / f"{NEW}0123456789ab-other", "half")
    (tmp_path / f"{NEW}0123456789ab-model.json").write_text("half")
    with atomic_directory(tmp_path / "model") as alive:
        (alive / "a").write_text("mine")
        (alive / "b").write_text("mine")
        write(tmp_path / "model", "theirs")
        assert alive.is_dir()
    assert content_of(tmp_path / "model") == "mine", "the last writer wins"
    write_text(tmp_path / "model.json", "whole")
    assert sorted(os.listdir(tmp_path)) == [f"{NEW}0123456789ab-other", "model", "model.json"]


def test_writers_at_the_same_time_leave_one_whole_folder(tmp_path: Path, way: str) -> None:
    errors: list[BaseException] = []

    def many(name: str) -> None:
        try:
            for number in range(40):
                write(tmp_path / "model", f"{name}{number}")
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=many, args=(name,)) for name in "xyz"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert content_of(tmp_path / "model")[1:] == "39"
    assert os.listdir(tmp_path) == ["model"]


def test_a_folder_that_another_writer_moves_is_never_taken_for_a_file(tmp_path: Path) -> None:
    """The folder goes right after it was first looked at, as when a second writer moves it aside."""
    target = folder(tmp_path / "model", "old")

    class Moved(type(target)):
        def exists(self, **options: object) -> bool:
            there = super().exists()
            if there:
                os.rename(target, tmp_path / "elsewhere")
            return there

    assert not is_other_than_folder(Moved(target))
    assert is_other_than_folder(Path(os.devnull))
    assert not is_other_than_folder(tmp_path / "none")
    (tmp_path / "file").write_text("")
    assert is_other_than_folder(tmp_path / "file")


def test_a_link_is_written_through(tmp_path: Path) -> None:
    folder(tmp_path / "real", "old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert content_of(tmp_path / "real") == "new"


def test_a_file_does_not_replace_a_folder_nor_use_a_file_as_one(tmp_path: Path) -> None:
    with pytest.raises(DestinationError, match="is a folder"), atomic_file(tmp_path):
        pass
    (tmp_path / "file").write_text("precious")
    with pytest.raises(DestinationError, match="cannot be written"):
        write_text(tmp_path / "file" / "below", "text")
    with pytest.raises(OSError, match="cannot be written"):
        write(tmp_path / "file" / "below", "text")


def test_permissions_follow_the_umask_and_may_be_private(tmp_path: Path) -> None:
    before = os.umask(0o022)
    try:
        write_text(tmp_path / "open", "")
        with atomic_file(tmp_path / "private", mode=0o600) as temporary:
            temporary.write_text("")
    finally:
        os.umask(before)
    assert (tmp_path / "open").stat().st_mode & 0o777 == 0o644
    assert (tmp_path / "private").stat().st_mode & 0o777 == 0o600
