"""When the recorder ends before the disk is full, told how much is free."""

from pathlib import Path

import pytest

from maniple.core.errors import RecordingError
from maniple.host.recorder_space import Space, free_bytes

MB = 1_000_000


class Disk:
    """One with as much room as a test says."""

    def __init__(self, free: int) -> None:
        self.free = free
        self.space = Space(Path("logs"), 100 * MB, lambda _: self.free)


def test_too_little_to_begin_with() -> None:
    disk = Disk(100 * MB)
    disk.space.require()
    disk.free = 99 * MB
    with pytest.raises(RecordingError, match=r"only 99 MB are free in logs, less than .* \(--min-free\)"):
        disk.space.require()


def test_low_is_said_once_and_again_after_there_was_room() -> None:
    disk = Disk(500 * MB)
    assert disk.space.look(0.0) == ("ample", "")
    disk.free = 299 * MB
    assert disk.space.look(0.5) == ("ample", "")  # not more often than once a second
    assert disk.space.look(1.0) == ("low", "only 299 MB are free in logs; at 100 MB the recording ends")
    assert disk.space.look(2.0) == ("low", "")
    disk.free = 300 * MB
    assert disk.space.look(3.0) == ("ample", "")
    disk.free = 100 * MB
    assert disk.space.look(4.0)[1]
    disk.free = 99 * MB
    room, text = disk.space.look(5.0)
    assert room == "none"
    assert "only 99 MB are free" in text


def test_nothing_is_to_be_left() -> None:
    space = Space(Path("logs"), 0, lambda _: 0)
    space.require()
    assert space.look(0.0) == ("ample", "")


def test_a_folder_that_can_not_be_asked_is_left_to_the_writer(tmp_path: Path) -> None:
    space = Space(tmp_path / "none", 1 << 60)
    space.require()
    assert space.look(0.0) == ("ample", "")


def test_a_real_disk(tmp_path: Path) -> None:
    assert free_bytes(tmp_path) > 0
    with pytest.raises(RecordingError, match="are free"):
        Space(tmp_path, 1 << 62).require()
