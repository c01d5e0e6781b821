"""What was read of a file is read again once the file is another one, and not before."""

import os

import pytest

from nerfvol.files.unchanged import while_unchanged


def test_a_file_is_read_again_once_it_changed(tmp_path):
    path, asked = tmp_path / "file", []

    @while_unchanged(2)
    def text(path):
        asked.append(path)
        return path.read_text()

    with pytest.raises(FileNotFoundError):
        text(path)
    path.write_text("one")
    assert [text(path), text(path)] == ["one", "one"] and len(asked) == 2
    path.write_text("three")  # another size
    assert text(path) == "three"
    path.write_text("seven")  # the same size, later
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 10**9))
    assert text(path) == "seven" and len(asked) == 4
