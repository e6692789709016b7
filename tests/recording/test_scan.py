"""What a scan makes of damage; that everything is found in whole files is tested with the reader."""

import random
import struct
from pathlib import Path

import pytest

from maniple.core.errors import RecordingError
from maniple.recording.scan import DAMAGE, Layout, NothingRecordedError, checksum_of, read_chunk, scan
from maniple.recording.writer import Compression
from tests.recording.traffic import record, traffic

_HEAD = 9


@pytest.fixture(params=["zstd", "none"])
def whole(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    compression: Compression = request.param
    return record(tmp_path / "a.mcap", traffic(60), compression)


def patched(path: Path, offset: int, data: bytes) -> Path:
    content = bytearray(path.read_bytes())
    content[offset : offset + len(data)] = data
    path.write_bytes(content)
    return path


def chunks(layout: Layout) -> list[int]:
    return [place.offset for place in layout.chunks]


def test_a_whole_file_has_no_damage(whole: Path) -> None:
    layout = scan(whole)
    assert (layout.complete, layout.torn, layout.damage) == (True, 0, [])
    assert checksum_of(layout) is None
    assert layout.size == whole.stat().st_size


@pytest.mark.parametrize("length", [0, 1, 10**6, 2**40, 2**60, 2**64 - 1])
def test_a_wrong_record_length_costs_that_record_only(whole: Path, length: int) -> None:
    """Of a chunk not even that, as its content has lengths of its own."""
    before = scan(whole)
    place = before.chunks[2]
    patched(whole, place.offset - 8, struct.pack("<Q", length))
    layout = scan(whole)
    assert layout.complete
    assert chunks(layout) == chunks(before)
    assert f"the length of the chunk at byte {place.offset} is wrong" in str(layout.damage[0])


def test_the_next_record_is_found_after_garbage(whole: Path) -> None:
    before = scan(whole)
    second, third = before.chunks[1:3]
    patched(whole, second.offset - _HEAD, random.Random(1).randbytes(third.offset - _HEAD - second.offset))
    layout = scan(whole)
    assert layout.complete
    assert chunks(layout) == [place for place in chunks(before) if place != second.offset]
    assert layout.damage[0].offset == second.offset - _HEAD
    assert layout.channels == before.channels


def test_a_lost_summary(whole: Path) -> None:
    """Nothing that was recorded is in it."""
    before = scan(whole)
    patched(whole, before.data_end + 20, b"\xff\xff\xff")
    layout = scan(whole)
    assert (layout.complete, chunks(layout)) == (True, chunks(before))
    assert "no message is in it" in str(layout.damage[0])
    assert checksum_of(layout) is None


def test_channels_are_those_of_the_summary(whole: Path) -> None:
    before = scan(whole)
    offset = whole.read_bytes().index(b"maniple/hw/r1/drive")
    layout = scan(patched(whole, offset + 8, b"xx"))
    assert layout.channels == before.channels
    assert "is not what the summary says of it" in str(layout.damage[0])


def test_times_of_a_chunk_are_checked(whole: Path) -> None:
    """They say in which order chunks are read."""
    before = scan(whole)
    place = before.chunks[1]
    layout = scan(patched(whole, place.offset, struct.pack("<Q", place.start_ns + 1)))
    assert "not where or when the summary says" in str(layout.damage[0])
    [changed] = [found for found in layout.chunks if found.offset == place.offset]
    with whole.open("rb") as file:
        with pytest.raises(ValueError, match="times"):
            read_chunk(file, changed, layout.channels)
        assert read_chunk(file, changed, layout.channels, times=False)


def test_a_chunk_that_claims_to_be_huge_takes_no_memory(whole: Path) -> None:
    place = scan(whole).chunks[1]
    patched(whole, place.offset + 16, struct.pack("<Q", 2**60))
    with whole.open("rb") as file, pytest.raises(ValueError, match="claims to hold"):
        read_chunk(file, place, {})
    patched(whole, place.offset + 16, struct.pack("<Q", 2**29))
    with whole.open("rb") as file, pytest.raises(DAMAGE):
        read_chunk(file, place, {})


def test_garbage_has_no_records(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + random.Random(2).randbytes(3_000_000))
    layout = scan(path)
    assert (layout.complete, layout.chunks) == (False, [])


def test_a_file_of_nothing_but_beginnings_is_read_in_time(tmp_path: Path) -> None:
    """Each could be a record, and none is."""
    path = tmp_path / "a.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + (b"\x06\x30\0\0\0\0\0\0\0" + b"\x06\0\0") * 20_000)
    assert scan(path).chunks == []


def test_the_first_bytes(whole: Path, tmp_path: Path) -> None:
    patched(whole, 0, b"\x00")
    with pytest.raises(RecordingError, match="not an MCAP file"):
        scan(whole)
    layout = scan(whole, lenient=True)
    assert layout.complete
    assert layout.chunks
    (empty := tmp_path / "b.mcap").write_bytes(b"")
    with pytest.raises(NothingRecordedError, match="empty"):
        scan(empty, lenient=True)
