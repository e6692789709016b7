"""Oracle: the official library's two readers, with every checksum."""

import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, SeekingReader

from maniple.recording.mcap_file import McapFile
from maniple.recording.writer import Compression
from tests.recording.traffic import SCENARIO, record, traffic

UINT64 = 2**64 - 1


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_official_readers_agree(tmp_path: Path, compression: Compression) -> None:
    sent = traffic()
    path = record(tmp_path / "a.mcap", sent, compression)
    expected = [(f"maniple/{m.topic}", m.data, m.log_time_ns, m.publish_time_ns, m.sequence) for m in sent]
    for reader in (SeekingReader, NonSeekingReader):
        with path.open("rb") as file:
            found = [
                (channel.topic, message.data, message.log_time, message.publish_time, message.sequence)
                for _, channel, message in reader(file, validate_crcs=True).iter_messages()
            ]
        assert found == expected


def test_summary_describes_the_file(tmp_path: Path) -> None:
    sent = traffic()
    with record(tmp_path / "a.mcap", sent).open("rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        statistics = summary.statistics
        assert statistics is not None
        assert statistics.message_count == len(sent)
        assert statistics.message_start_time == sent[0].log_time_ns
        assert statistics.message_end_time == sent[-1].log_time_ns
        assert statistics.chunk_count == len(summary.chunk_indexes)
        assert statistics.schema_count == len(summary.schemas)
        counts = {
            summary.channels[channel].topic: count
            for channel, count in statistics.channel_message_counts.items()
        }
        assert counts == {f"maniple/{name}": 40 for name in {m.topic for m in sent}}
        [attachment] = reader.iter_attachments()
        assert attachment.data == SCENARIO
        [metadata] = reader.iter_metadata()
        assert metadata.metadata["seed"] == "7"


messages = st.tuples(
    st.integers(0, 2), st.integers(0, 20) | st.integers(0, UINT64), st.binary(max_size=40), st.booleans()
)


@settings(deadline=None, max_examples=60, derandomize=True)
@given(st.lists(messages, max_size=30))
def test_any_messages_in_any_order(given: list[tuple[int, int, bytes, bool]]) -> None:
    """By log time, then as written; a flush after those marked."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        with path.open("xb", buffering=0) as raw:
            mcap = McapFile(raw, "test", compress=True)
            channels = [mcap.add_channel(f"c{i}", "msgpack", 0, {}) for i in range(3)]
            for number, (channel, time, data, flush) in enumerate(given):
                mcap.add_message(channels[channel], time, 5, number, data)
                if flush:
                    mcap.flush()
            mcap.finish()
        with path.open("rb") as file:
            found = [
                (channel.topic, message.log_time, message.data, message.sequence)
                for _, channel, message in SeekingReader(file, validate_crcs=True).iter_messages()
            ]
    expected = [(f"c{c}", time, data, number) for number, (c, time, data, _) in enumerate(given)]
    assert found == sorted(expected, key=lambda entry: (entry[1], entry[3]))
