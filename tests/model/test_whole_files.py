"""Files appear whole or not at all."""

from __future__ import annotations

import fcntl
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from tests.instances import ring_projectile

from tolnet import model
from tolnet.model import InputError, check_writable, replacing


class Interrupted(Exception):
    """Something that happens while a file is being written."""


def test_what_is_interrupted_leaves_the_old_file_and_nothing_else(tmp_path):
    target = tmp_path / "x.txt"
    target.write_bytes(b"old")
    with pytest.raises(Interrupted), replacing(target) as file:  # noqa: PT012 - what happens inside is the point
        file.write(b"half")
        raise Interrupted
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_what_ends_well_replaces_it(tmp_path):
    target = tmp_path / "x.txt"
    target.write_bytes(b"old")
    target.chmod(0o640)
    with replacing(target) as file:
        file.write(b"new")
        assert target.read_bytes() == b"old"
    assert target.read_bytes() == b"new"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    assert list(tmp_path.iterdir()) == [target]


def test_a_link_keeps_pointing(tmp_path):
    (tmp_path / "real.txt").write_bytes(b"old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    with replacing(tmp_path / "link.txt") as file:
        file.write(b"new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_bytes() == b"new"


def test_a_link_that_leads_to_itself_is_replaced(tmp_path):
    (tmp_path / "loop.txt").symlink_to("loop.txt")
    with replacing(tmp_path / "loop.txt") as file:
        file.write(b"new")
    assert (tmp_path / "loop.txt").read_bytes() == b"new"


def no_folder(folder: Path) -> Path:
    return folder / "none" / "x.toml"


def below_a_file(folder: Path) -> Path:
    (folder / "f").write_bytes(b"")
    return folder / "f" / "x.toml"


def a_directory(folder: Path) -> Path:
    return folder


def a_pipe(folder: Path) -> Path:
    os.mkfifo(folder / "pipe.toml")
    return folder / "pipe.toml"


def no_name(folder: Path) -> Path:
    return folder / "a\0b.toml"


def a_name_too_long(folder: Path) -> Path:
    return folder / ("x" * 300 + ".toml")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (no_folder, "cannot be written: .*none does not exist"),
        (below_a_file, "cannot be written: .*f is not a directory"),
        (a_directory, "cannot be written: it is a directory"),
        (a_pipe, "cannot be written: it is not a regular file"),
        (no_name, "cannot be written: embedded null byte"),
        (a_name_too_long, "cannot be written: File name too long"),
    ],
)
def test_targets_that_cannot_be_written(tmp_path, make, message):
    target = make(tmp_path)
    with pytest.raises(InputError, match=message) as caught:
        model.save(ring_projectile(), target)
    assert caught.value.source == str(target)
    with pytest.raises(InputError, match=message):
        check_writable(target)
    with pytest.raises(InputError, match=message), replacing(target):
        pass


def test_a_target_that_is_write_protected(tmp_path, monkeypatch):
    (tmp_path / "x.toml").write_bytes(b"old")
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)  # root may write everything
    with pytest.raises(InputError, match="cannot be written: it is write-protected"):
        model.save(ring_projectile(), tmp_path / "x.toml")


def test_a_disk_that_is_full(tmp_path, monkeypatch):
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    (tmp_path / "x.toml").write_bytes(b"old")
    with pytest.raises(InputError, match="cannot be written: No space left on device"):
        model.save(ring_projectile(), tmp_path / "x.toml")
    assert (tmp_path / "x.toml").read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


def test_nothing_is_written_where_the_archive_cannot_be(tmp_path):
    (tmp_path / "x.npz").mkdir()
    with pytest.raises(InputError, match=r"x\.npz: cannot be written: it is a directory"):
        model.save(ring_projectile(), tmp_path / "x.toml", arrays=True)
    assert not (tmp_path / "x.toml").exists()


def test_a_problem_file_is_not_its_own_archive(tmp_path):
    with pytest.raises(InputError, match="is the name of an archive; give the problem file another suffix"):
        model.save(ring_projectile(), tmp_path / "x.npz")


def test_asking_writes_nothing(tmp_path):
    check_writable(tmp_path / "x.txt")
    assert list(tmp_path.iterdir()) == []


def test_what_killed_writers_left_is_removed_by_the_next_write(tmp_path):
    stale = tmp_path / ".tolnet-0123456789ab.part"
    others = [tmp_path / name for name in (".tolnet-notes", "a.part", ".tolnet-x.part.bak")]
    for path in (stale, *others):
        path.write_bytes(b"half")
    (tmp_path / ".tolnet-folder.part").mkdir()
    (tmp_path / ".tolnet-link.part").symlink_to("a.part")
    os.mkfifo(tmp_path / ".tolnet-pipe.part")
    with replacing(tmp_path / "x.txt") as file:
        file.write(b"new")
    assert not stale.exists()
    assert all(path.read_bytes() == b"half" for path in others)
    assert len(list(tmp_path.iterdir())) == len(others) + 4


def test_what_is_being_written_is_not_stale(tmp_path):
    with replacing(tmp_path / "slow.txt") as slow:
        slow.write(b"slow")
        with replacing(tmp_path / "fast.txt") as fast:
            fast.write(b"fast")
        assert len(list(tmp_path.glob(".tolnet-*.part"))) == 1
    assert (tmp_path / "slow.txt").read_bytes() == b"slow"
    assert (tmp_path / "fast.txt").read_bytes() == b"fast"


def test_another_process_that_is_killed_leaves_what_the_next_write_removes(tmp_path):
    program = (
        "import pathlib, sys, time; from tolnet.model import replacing\n"
        "with replacing(pathlib.Path(sys.argv[1])) as file:\n    print('open', flush=True)\n    time.sleep(600)\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "theirs.txt")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == b"open\n"
        with replacing(tmp_path / "ours.txt"):
            assert len(list(tmp_path.glob(".tolnet-*.part"))) == 2
        writer.kill()
    assert len(list(tmp_path.glob(".tolnet-*.part"))) == 1
    with replacing(tmp_path / "ours.txt"):
        pass
    assert list(tmp_path.iterdir()) == [tmp_path / "ours.txt"]


def test_a_file_taken_for_stale_before_its_lock_is_begun_again(tmp_path, monkeypatch):
    """Somebody may remove what is created and not yet locked; the writer then takes another name."""
    lock, removed = fcntl.flock, []

    def flock(handle: int, operation: int) -> None:
        if not removed:
            removed.extend(tmp_path.glob(".tolnet-*.part"))
            removed[0].unlink()
        lock(handle, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    with replacing(tmp_path / "x.txt") as file:
        file.write(b"new")
    assert len(removed) == 1
    assert (tmp_path / "x.txt").read_bytes() == b"new"


def test_where_there_are_no_locks_nothing_is_removed(tmp_path, monkeypatch):
    def flock(handle: int, operation: int) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", flock)
    (tmp_path / ".tolnet-0123456789ab.part").write_bytes(b"half")
    with replacing(tmp_path / "x.txt") as file:
        file.write(b"new")
    assert (tmp_path / "x.txt").read_bytes() == b"new"
    assert (tmp_path / ".tolnet-0123456789ab.part").exists()
