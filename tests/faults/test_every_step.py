"""Faults at every step of every writer: what is at the path is the old version or the new one, never less.

A process dies, the disk is full, or a quota ends, at the first step in the file system, the second, and so
on until the writer gets through; then the same write is made again, succeeds, and leaves no litter.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from faults.injection import ENDED, KILLED, REFUSED, SURVIVED, die, in_child, limited_child
from faults.writers import WRITERS, Writer

MOST_STEPS = 80
CODES = [errno.ENOSPC, errno.EROFS]
if os.environ.get("FORCEGP_ATTACK"):
    CODES += [errno.EDQUOT, errno.EIO, errno.EACCES]

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork"), reason="children are forked"),
    pytest.mark.filterwarnings("ignore:.*fork.*"),
]


@pytest.fixture(params=WRITERS, ids=lambda writer: writer.name)
def writer(request: pytest.FixtureRequest) -> Writer:
    return request.param


def read(writer: Writer, path: Path) -> int | None:
    """The version at a path, `None` where there is nothing; damage raises."""
    if not path.exists():
        return None
    return writer.read(path)


@pytest.mark.parametrize("before", [None, 1], ids=["nothing before", "a version before"])
def test_a_kill_at_any_step_leaves_the_old_or_the_new(
    writer: Writer, before: int | None, tmp_path: Path
) -> None:
    path, killed = tmp_path / f"target{writer.ending}", 0
    for step in range(1, MOST_STEPS):
        if before is not None:
            writer.write(path, before)
        code = in_child(lambda: writer.write(path, 2), tmp_path, step, die)
        found = read(writer, path)
        assert code in (KILLED, ENDED), f"step {step}: exit code {code}"
        assert found in (before, 2, writer.also), f"step {step}: version {found}"
        writer.write(path, 2)
        assert read(writer, path) == 2
        if writer.name != "kernels":
            assert os.listdir(tmp_path) == [path.name], f"litter after a kill at step {step}"
            if code == ENDED:
                assert found == 2
        if code == ENDED:
            break
        killed += 1
        remove(path)
    assert 2 <= killed < MOST_STEPS - 2, "the steps were found"


@pytest.mark.parametrize("code", CODES)
def test_a_call_that_fails_at_any_step_is_an_os_error_and_keeps_the_old(
    writer: Writer, code: int, tmp_path: Path
) -> None:
    path, refused, step = tmp_path / f"target{writer.ending}", 0, 0

    def fail() -> None:
        raise OSError(code, os.strerror(code))

    writer.write(path, 1)
    for step in range(1, MOST_STEPS):
        outcome = in_child(lambda: writer.write(path, 2), tmp_path, step, fail)
        found = read(writer, path)
        assert outcome in (ENDED, REFUSED, SURVIVED), f"step {step}: exit code {outcome}"
        assert found in (1, 2), f"step {step}: version {found}"
        refused += outcome == REFUSED
        if outcome == ENDED:
            break
        writer.write(path, 1)
        if writer.name != "kernels":
            assert os.listdir(tmp_path) == [path.name], f"litter after a failure at step {step}"
    assert refused >= 2 and step < MOST_STEPS - 1


def test_a_quota_that_ends_in_the_middle_of_a_file_keeps_the_old(writer: Writer, tmp_path: Path) -> None:
    path = tmp_path / f"target{writer.ending}"
    writer.write(path, 1)
    for size in (0, 1, 10):
        if writer.name in ("text", "folder") and size > 0:
            continue
        assert limited_child(lambda: writer.write(path, 2), size) == REFUSED
        assert read(writer, path) == 1
    assert writer.name == "kernels" or os.listdir(tmp_path) == [path.name]


@pytest.mark.skipif(os.name == "posix" and os.geteuid() == 0, reason="root writes everywhere")
def test_a_read_only_folder_is_refused(writer: Writer, tmp_path: Path) -> None:
    path = tmp_path / "shut" / f"target{writer.ending}"
    path.parent.mkdir()
    writer.write(path, 1)
    path.parent.chmod(0o500)
    with pytest.raises(OSError, match=r"cannot be written|Permission denied"):
        writer.write(path, 2)
    path.parent.chmod(0o700)
    assert read(writer, path) == 1


def test_two_writers_and_a_reader_never_see_half(writer: Writer, tmp_path: Path) -> None:
    path, rounds = tmp_path / f"target{writer.ending}", 8
    writer.write(path, 1)

    def many(version: int) -> None:
        for _ in range(rounds):
            writer.write(path, version)

    children = []
    for version in (1, 2):
        child = os.fork()
        if child == 0:
            try:
                many(version)
                os._exit(0)
            except BaseException:
                import traceback

                traceback.print_exc()
                os._exit(1)
        children.append(child)
    codes: list[int] = []
    while len(codes) < 2:
        if writer.name != "folder":
            assert read(writer, path) in (1, 2)
        for child in list(children):
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                children.remove(child)
                codes.append(os.waitstatus_to_exitcode(status))
    assert codes == [0, 0]
    assert read(writer, path) in (1, 2)
    assert writer.name == "kernels" or os.listdir(tmp_path) == [path.name]


def remove(path: Path) -> None:
    """Remove what a writer wrote."""
    import shutil

    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
