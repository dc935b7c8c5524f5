"""A result is not computed for a place that cannot take it, and not lost if the place fails later."""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from pathlib import Path

import pytest

from forcegp import destination
from forcegp.destination import MANIFEST, check_destination, check_folder, folder_or_keep, write_or_keep
from forcegp.errors import DestinationError, ModelError
from forcegp.files import write_text, written_folder


def test_a_place_that_can_be_written_is_left_as_it_was(tmp_path: Path) -> None:
    check_destination(tmp_path / "a" / "b" / "model", folder=True)
    check_destination(tmp_path / "run.parquet")
    assert os.listdir(tmp_path) == []


def test_kinds_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("precious")
    with pytest.raises(DestinationError, match="is a file, but a folder"):
        check_destination(tmp_path / "file", folder=True)
    with pytest.raises(DestinationError, match="is a folder, but a file"):
        check_destination(tmp_path)
    with pytest.raises(DestinationError, match="cannot be written"):
        check_destination(tmp_path / "file" / "model", folder=True)


def test_a_foreign_folder_is_refused(tmp_path: Path) -> None:
    target = tmp_path / "results"
    for _ in range(2):
        check_folder(target)
        folder_or_keep(lambda folder: (folder / "README.md").write_text("ours"), target)
    (target / "thesis.tex").write_text("years of work")
    with pytest.raises(DestinationError, match=r"would be lost(.|\n)*got: thesis\.tex"):
        check_folder(target)
    (target / "thesis.tex").unlink()
    check_folder(target)
    (target / "build").mkdir()
    with pytest.raises(DestinationError, match="got: build"):
        check_folder(target)
    (target / "build").rmdir()
    (target / "README.md").write_text("changed by the user")
    with pytest.raises(DestinationError, match=r"got: README\.md"):
        check_folder(target)


@pytest.mark.parametrize(
    "manifest", [None, "", "{}", '{"format": "forcegp-folder", "version": 1, "files": {}}']
)
def test_a_folder_with_the_names_of_a_result_is_foreign(manifest: str | None, tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("years of work")
    if manifest is not None:
        (tmp_path / MANIFEST).write_text(manifest)
    with pytest.raises(DestinationError, match=r"would be lost(.|\n)*README\.md"):
        check_folder(tmp_path)


def test_files_that_came_during_the_computation_are_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, spare = tmp_path / "results", tmp_path / "spare"
    spare.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(spare))

    def fill(folder: Path) -> None:
        target.mkdir(exist_ok=True)
        (target / "thesis.tex").write_text("years of work")
        (folder / "a").write_text("the result")

    with pytest.raises(DestinationError, match="it was saved to"):
        folder_or_keep(fill, target)
    assert (target / "thesis.tex").read_text() == "years of work"
    [kept] = spare.iterdir()
    assert (kept / "results" / "a").read_text() == "the result"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes")
def test_a_pipe_or_a_device_is_not_replaced_by_a_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path(os.devnull)):
        with pytest.raises(DestinationError, match="is not a regular file"):
            check_destination(path)
        with pytest.raises(DestinationError, match="is not a regular file"):
            write_text(path, "lost")
        assert not stat.S_ISREG(path.stat().st_mode)


@pytest.mark.parametrize("folder", [False, True])
def test_a_name_that_is_too_long_is_refused_and_the_longest_written(folder: bool, tmp_path: Path) -> None:
    with pytest.raises(DestinationError, match="too long"):
        check_destination(tmp_path / ("a" * 300), folder=folder)
    longest = tmp_path / ("ä" * 123 + ".parquet")
    check_destination(longest, folder=folder)
    for text in ("one", "two"):
        if folder:
            with written_folder(longest) as temporary:
                (temporary / "a").write_text(text)
        else:
            write_text(longest, text)
    assert os.listdir(tmp_path) == [longest.name]
    assert (longest / "a" if folder else longest).read_text() == "two"


def test_a_full_disk_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(destination.os, "fsync", full)
    with pytest.raises(DestinationError, match="No space left"):
        check_destination(tmp_path / "model")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("kind", ["a file in the way", "a full disk"])
def test_a_result_that_cannot_be_written_is_kept(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, spare = tmp_path / "results", tmp_path / "spare"
    spare.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(spare))
    place.write_text("in the way")

    def write(path: Path) -> None:
        if kind == "a full disk" and path.is_relative_to(place):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        path.mkdir()
        (path / "model.json").write_text("the result")

    with pytest.raises(DestinationError, match=r"could not be written(.|\n)*it was saved to") as error:
        write_or_keep(write, place / "model")
    [kept] = spare.iterdir()
    assert str(kept / "model") in str(error.value)
    assert (kept / "model" / "model.json").read_text() == "the result"
    assert kept.stat().st_mode & 0o777 == 0o700


def test_a_result_that_can_be_written_nowhere_says_why(tmp_path: Path) -> None:
    def write(path: Path) -> None:
        raise ModelError("a kernel in Python cannot be saved")

    with pytest.raises(ModelError, match="cannot be saved"):
        write_or_keep(write, tmp_path / "model")
