"""Kernels are code: nobody else's are loaded, and none that is damaged."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from forcegp import dynamics, native
from forcegp.compiled import compile_dynamics
from forcegp.errors import MissingDependencyError
from forcegp.files import NEW
from random_robots import random_robot
from robots import random_states

ROBOT = random_robot(0, nq=2)
Q = random_states(ROBOT, 3)[0]
OTHER = 12345
"""A user who is not us."""

pytestmark = pytest.mark.skipif(os.name != "posix", reason="owners and permissions of POSIX")


def compiled() -> torch.Tensor:
    return compile_dynamics(ROBOT, "gravity_force")(Q)


@pytest.fixture(scope="module")
def warm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache with one kernel in it."""
    folder = tmp_path_factory.mktemp("warm") / "cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FORCEGP_CACHE", str(folder))
        compiled()
    return folder


@pytest.fixture
def folder(warm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of that cache, in use."""
    own = tmp_path / "cache"
    own.mkdir(mode=0o700)
    for file in warm.iterdir():
        (own / file.name).write_bytes(file.read_bytes())
        (own / file.name).chmod(0o600)
    monkeypatch.setenv("FORCEGP_CACHE", str(own))
    return own


@pytest.fixture
def compilations(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one entry with every run of the compiler."""
    runs: list[int] = []
    original = native._run_compiler

    def counted(*args: object) -> None:
        runs.append(1)
        original(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(native, "_run_compiler", counted)
    return runs


def test_a_kernel_in_the_cache_is_used(folder: Path, compilations: list[int]) -> None:
    compiled()
    assert compilations == []


@pytest.mark.parametrize("mask", [0o000, 0o077, 0o777])
def test_folder_and_files_are_private_whatever_the_umask(
    mask: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCEGP_CACHE", str(tmp_path / "kernels"))
    before = os.umask(mask)
    try:
        compiled()
    finally:
        os.umask(before)
    [kernel] = (tmp_path / "kernels").iterdir()
    assert kernel.stat().st_mode & 0o777 == 0o600
    assert kernel.parent.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777])
def test_a_folder_that_others_write_is_refused(mode: int, folder: Path) -> None:
    folder.chmod(mode)
    with pytest.raises(MissingDependencyError, match=rf"other users could place code there(.|\n)*{mode:04o}"):
        compiled()


def test_a_folder_below_one_that_others_write_is_refused(tmp_path: Path, folder: Path) -> None:
    tmp_path.chmod(0o777)
    with pytest.raises(MissingDependencyError, match="other users could place code there"):
        compiled()
    tmp_path.chmod(0o1777)
    compiled()


@pytest.mark.skipif(not hasattr(os, "setxattr"), reason="access control lists of Linux")
@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize(("tag", "permissions"), [(0x02, 7), (0x08, 7), (0x02, 5)])
def test_a_folder_with_an_access_control_list_is_refused(
    above: bool, tag: int, permissions: int, tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the group bits, which are those of the mask, could belong to a group of our own."""
    monkeypatch.setattr(native, "_is_alone_in", lambda _: True)
    entries = sorted([(0x01, 7), (tag, permissions), (0x04, 5), (0x10, 7 if above else 5), (0x20, 0)])
    acl = b"".join(struct.pack("<HHI", *entry, OTHER if entry[0] == tag else 2**32 - 1) for entry in entries)
    try:
        os.setxattr(tmp_path if above else folder, native.ACL, struct.pack("<I", 2) + acl)
    except OSError:
        pytest.skip("this file system has no access control lists")
    with pytest.raises(MissingDependencyError, match="access control list"):
        compiled()


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root can give files away")
def test_a_folder_below_one_that_a_foreign_group_writes_is_refused(tmp_path: Path, folder: Path) -> None:
    os.chown(tmp_path, os.geteuid(), OTHER)
    tmp_path.chmod(0o775)
    with pytest.raises(MissingDependencyError, match=r"other users could place code there(.|\n)*0775"):
        compiled()
    tmp_path.chmod(0o755)
    compiled()


def test_a_private_group_may_write_above(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tmp_path.chmod(0o775)
    monkeypatch.setattr(native, "_is_alone_in", lambda group: group == tmp_path.stat().st_gid)
    compiled()
    monkeypatch.setattr(native, "_is_alone_in", lambda group: False)
    with pytest.raises(MissingDependencyError, match="other users could place code there"):
        compiled()


@pytest.mark.skipif(not native.PROC.is_dir(), reason="folders have names by descriptor on Linux")
def test_what_is_put_in_the_place_of_the_build_folder_is_not_loaded(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder is exchanged by name while the compiler runs, with a planted library in the new one."""
    [kernel] = folder.iterdir()
    kernel.unlink()
    content, original = planted(folder), native._run_compiler

    def exchanged(compiler: object, source: str, place: Path) -> None:
        [build] = folder.glob(f"{NEW}*-build")
        build.rename(folder.parent / "moved")
        build.mkdir(mode=0o700)
        (build / native.LIBRARY).write_bytes(content)
        original(compiler, source, place)  # type: ignore[arg-type]
        (build / native.LIBRARY).write_bytes(content)

    monkeypatch.setattr(native, "_run_compiler", exchanged)
    torch.testing.assert_close(compiled(), dynamics.gravity_force(ROBOT, Q))


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root can give files away")
def test_what_others_own_is_refused(folder: Path, compilations: list[int]) -> None:
    [kernel] = folder.iterdir()
    os.chown(kernel, OTHER, OTHER)
    compiled()
    assert compilations == [1], "a kernel of another user is not loaded"
    os.chown(folder, OTHER, OTHER)
    with pytest.raises(MissingDependencyError, match=rf"owned by user {OTHER}"):
        compiled()


def planted(folder: Path) -> bytes:
    """A library with the right symbol that tells of being run."""
    text = 'extern "C" void kernel(const double* const*, double* out, long n, long) { out[0] = 666; }'
    library = folder.parent / "planted.so"
    command = [native.find_compiler(), "-shared", "-fPIC", "-x", "c++", "-", "-o", str(library)]
    subprocess.run(command, input=text, text=True, check=True)
    return library.read_bytes()


@pytest.mark.parametrize("damage", ["planted", "truncated", "flipped", "link", "writable", "empty"])
def test_what_is_damaged_is_built_anew(damage: str, folder: Path, compilations: list[int]) -> None:
    [kernel] = folder.iterdir()
    content = kernel.read_bytes()
    if damage == "planted":
        kernel.write_bytes(planted(folder))
    elif damage == "truncated":
        kernel.write_bytes(content[: len(content) // 2])
    elif damage == "empty":
        kernel.write_bytes(b"")
    elif damage == "flipped":
        kernel.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    elif damage == "writable":
        kernel.chmod(0o622)
    else:
        kernel.rename(folder.parent / "elsewhere.so")
        kernel.symlink_to(folder.parent / "elsewhere.so")
    torch.testing.assert_close(compiled(), dynamics.gravity_force(ROBOT, Q))
    assert compilations == [1]
    [kernel] = folder.iterdir()
    assert native._trusted(kernel)


def test_a_kernel_that_does_not_load_is_built_anew(
    folder: Path, compilations: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The digest is right and the file is no library of this machine."""
    [kernel] = folder.iterdir()
    key = kernel.name.partition("-")[0]
    kernel.unlink()
    native.store(folder, key, b"\x7fELF of another machine")
    compiled()
    assert compilations == [1]


def test_litter_of_a_killed_compiler_is_removed(folder: Path) -> None:
    [kernel] = folder.iterdir()
    kernel.unlink()
    litter = folder / f"{NEW}0123456789ab-build"
    litter.mkdir()
    (litter / "kernel.so").write_text("half")
    compiled()
    assert not litter.exists()


def test_a_truncated_kernel_does_not_kill_the_process(folder: Path) -> None:
    """A mapped file that ends early raises SIGBUS, which no `except` catches: so in a process of its own."""
    [kernel] = folder.iterdir()
    kernel.write_bytes(kernel.read_bytes()[:4096])
    code = (
        "from pathlib import Path\nfrom forcegp import native\n"
        f"print(native.find(Path({str(folder)!r}), {kernel.name.partition('-')[0]!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "None"), done.stderr
