"""Atomic writing: the old file survives every failure, and the message names the path."""

import errno
import json
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from nerfvol.errors import InputError
from nerfvol.files import atomic


def test_success_replaces_and_leaves_no_temporary(tmp_path):
    target = tmp_path / "a.png"
    target.write_bytes(b"old")
    with atomic.atomic_write(target) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".png"
        temporary.write_bytes(b"new")
        assert target.read_bytes() == b"old"  # readers see the old file until the rename
    assert target.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["a.png"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_full_disk_keeps_the_old_file(tmp_path, number):
    target = tmp_path / "a.bin"
    target.write_bytes(b"old")
    with pytest.raises(InputError, match=r"cannot write .*a\.bin: (no space|the disk quota)"):
        with atomic.atomic_write(target) as temporary:
            temporary.write_bytes(b"half")
            raise OSError(number, os.strerror(number))
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_other_exceptions_pass_and_clean_up(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        with atomic.atomic_write(tmp_path / "a.bin") as temporary:
            temporary.write_bytes(b"half")
            raise KeyboardInterrupt
    assert os.listdir(tmp_path) == []


def test_error_about_another_file_keeps_its_own_name(tmp_path):
    with pytest.raises(FileNotFoundError, match="elsewhere"):
        with atomic.atomic_write(tmp_path / "a.bin"):
            open(tmp_path / "elsewhere").close()


@pytest.mark.parametrize(
    "make, reason",
    [
        (lambda folder: folder / "missing" / "a.bin", "folder does not exist"),
        (lambda folder: (folder / "file").touch() or folder / "file" / "a.bin", "not a folder"),
        (lambda folder: (folder / "dir.bin").mkdir() or folder / "dir.bin", "it is a folder"),
    ],
)
def test_impossible_targets(tmp_path, make, reason):
    target = make(tmp_path)
    with pytest.raises(InputError, match=reason):
        atomic.write_bytes(target, b"x")


def test_killed_writer_leaves_the_old_file(tmp_path):
    target = tmp_path / "a.bin"
    target.write_bytes(b"old")
    code = (
        "import os, signal, sys; from nerfvol.files import atomic\n"
        "with atomic.atomic_write(sys.argv[1]) as t:\n"
        "    t.write_bytes(b'half'); os.kill(os.getpid(), signal.SIGKILL)"
    )
    root = Path(atomic.__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code, str(target)], cwd=root)
    assert done.returncode != 0
    assert target.read_bytes() == b"old"
    (left,) = (path for path in tmp_path.iterdir() if path != target)
    with atomic.atomic_write(tmp_path / "b.bin") as alive:  # of a process that is there
        alive.write_bytes(b"half")
        elsewhere = left.with_name(left.name.replace(atomic._machine(), "0" * 8))  # of another machine
        elsewhere.touch()
        atomic.remove_leftovers(tmp_path)
        assert set(tmp_path.iterdir()) == {target, alive, elsewhere}


def test_synced_before_it_is_renamed(tmp_path, monkeypatch):
    """A rename that reaches the disk before the data would leave an empty file after a power cut."""
    order = []
    sync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda fd: order.append("sync") or sync(fd))
    monkeypatch.setattr(os, "replace", lambda a, b: order.append("rename") or replace(a, b))
    atomic.write_bytes(tmp_path / "a.bin", b"x")
    assert order == ["sync", "rename", "sync"]  # the data, the name, the folder that holds the name


def test_json_round_trip_and_nan_refused(tmp_path):
    atomic.write_json(tmp_path / "a.json", {"psnr": 30.5, "rows": [1, 2]})
    assert atomic.read_json(tmp_path / "a.json") == {"psnr": 30.5, "rows": [1, 2]}
    with pytest.raises(ValueError):
        atomic.write_json(tmp_path / "a.json", {"psnr": float("nan")})
    assert json.loads((tmp_path / "a.json").read_text())["psnr"] == 30.5


@pytest.mark.parametrize(
    "content, reason", [(b"", "line 1"), (b"{", "not JSON"), (b"\xc3(", "UTF-8"), (b"[" * 100_000, "nested|JSON")]
)
def test_bad_json(tmp_path, content, reason):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=reason) as error:
        atomic.read_json(path)
    assert "a.json" in str(error.value)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="no such file.*nothing.json"):
        atomic.read_json(tmp_path / "nothing.json")


def test_ensure_writable_folder(tmp_path, monkeypatch):
    assert atomic.ensure_writable_folder(tmp_path / "a" / "b").is_dir()
    assert os.listdir(tmp_path / "a" / "b") == []
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file, not a folder"):
        atomic.ensure_writable_folder(tmp_path / "file")
    with pytest.raises(InputError, match="not a folder"):
        atomic.ensure_writable_folder(tmp_path / "file" / "below")

    def refuse(self, data):
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with pytest.raises(InputError, match="cannot write into .*permission denied"):
        atomic.ensure_writable_folder(tmp_path / "a")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_what_is_written_to_a_pipe_goes_through_it(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    got = []
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()))
    reader.start()
    atomic.write_text(pipe, "through")
    reader.join(300)
    assert got == [b"through"] and stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_link_stays_one_and_what_it_names_is_written(tmp_path):
    (tmp_path / "disk").mkdir()
    real, link = tmp_path / "disk" / "real.json", tmp_path / "link.json"
    real.write_text("old")
    link.symlink_to("disk/real.json")
    atomic.write_json(link, [1])
    assert link.is_symlink() and json.loads(real.read_text()) == [1]
    dangling = tmp_path / "new.json"
    dangling.symlink_to("disk/new.json")
    atomic.write_json(dangling, [2])
    assert json.loads((tmp_path / "disk" / "new.json").read_text()) == [2]


@pytest.mark.parametrize("text, reason", [
    ('{"a": 1, "b": {"c": 1, "c": 2}}', "states 'c' twice"), ("[" + "9" * 5000 + "]", "thousands of digits"),
])  # fmt: skip
def test_json_that_says_two_things_or_too_much_is_refused(tmp_path, text, reason):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=reason):
        atomic.read_json(tmp_path / "a.json")


def test_what_numpy_says_of_a_full_disk_is_said_as_one():
    assert atomic.explain_os_error(OSError("110592 requested and 32736 written")) == "no space is left on the device"
    assert atomic.explain_os_error(OSError("2 requested")) == "2 requested"
