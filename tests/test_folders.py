"""A folder takes its place in one step."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path

import pytest

from forcegp import files
from forcegp.destination import check_folder
from forcegp.errors import DestinationError
from forcegp.files import NEW, atomic_file, check_kind, write_text, written_folder


def folder(path: Path, content: str) -> Path:
    path.mkdir()
    (path / "a").write_text(content)
    (path / "b").write_text(content)
    return path


def write(path: Path, content: str) -> None:
    with written_folder(path) as temporary:
        (temporary / "a").write_text(content)
        (temporary / "b").write_text(content)


def content_of(path: Path) -> str:
    a, b = (path / "a").read_text(), (path / "b").read_text()
    assert a == b, "a mixture of two folders"
    return a


def test_files_of_two_versions_are_never_in_one_folder(tmp_path: Path) -> None:
    """Another thread opens the folder again and again while two versions replace each other."""
    target, done = folder(tmp_path / "page", "0"), threading.Event()
    seen: set[str] = set()

    def look() -> None:
        while not done.is_set():
            held = os.open(target, os.O_RDONLY | os.O_DIRECTORY)
            with suppress(FileNotFoundError):  # the folder that was opened is being deleted
                seen.add("".join(text_in(held, name) for name in "ab"))
            os.close(held)

    reader = threading.Thread(target=look)
    reader.start()
    for number in range(1, 100):
        write(target, str(number % 10))
    done.set()
    reader.join()
    assert len(seen) > 1 and all(a == b for a, b in seen)


def text_in(folder: int, name: str) -> str:
    with os.fdopen(os.open(name, os.O_RDONLY, dir_fd=folder)) as file:
        return file.read()


@pytest.mark.parametrize("before", [True, False])
def test_a_system_that_cannot_exchange_folders_replaces_them_too(
    before: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_exchange", lambda *_: False)
    if before:
        folder(tmp_path / "page", "old")
    write(tmp_path / "page", "new")
    assert content_of(tmp_path / "page") == "new" and os.listdir(tmp_path) == ["page"]


def test_permissions_of_a_folder_are_kept(tmp_path: Path) -> None:
    folder(tmp_path / "shared", "old").chmod(0o2775)
    write(tmp_path / "shared", "new")
    assert (tmp_path / "shared").stat().st_mode & 0o7777 == 0o2775


@pytest.mark.parametrize("name", [".", "..", "../here", "", "link"])
def test_the_current_folder_is_not_replaced(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    (here / "link").symlink_to(here)
    monkeypatch.chdir(here)
    for replace in (lambda: write(Path(name), "new"), lambda: check_folder(name)):
        with pytest.raises(DestinationError, match="the current folder cannot be replaced"):
            replace()
    assert os.listdir(here) == ["link"]


def test_litter_of_killed_writers_is_removed_and_work_of_live_ones_is_not(tmp_path: Path) -> None:
    folder(tmp_path / f"{NEW}0123456789ab-model", "half")
    folder(tmp_path / f"{NEW}0123456789ab-other", "half")
    (tmp_path / f"{NEW}0123456789ab-model.json").write_text("half")
    with written_folder(tmp_path / "model") as alive:
        (alive / "a").write_text("mine")
        (alive / "b").write_text("mine")
        write(tmp_path / "model", "theirs")
        assert alive.is_dir()
    assert content_of(tmp_path / "model") == "mine", "the last writer wins"
    write_text(tmp_path / "model.json", "whole")
    assert sorted(os.listdir(tmp_path)) == [f"{NEW}0123456789ab-other", "model", "model.json"]


def test_writers_at_the_same_time_leave_whole_files(tmp_path: Path) -> None:
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
    for name in ("a", "b"):
        assert (tmp_path / "model" / name).read_text()[1:] == "39"
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

    check_kind(Moved(target), folder=True)
    check_kind(tmp_path / "none", folder=True)
    (tmp_path / "file").write_text("")
    for taken in (tmp_path / "file", Path(os.devnull)):
        with pytest.raises(DestinationError, match="is a file"):
            check_kind(taken, folder=True)


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
