"""A recording as an MCAP file for Foxglove and Lichtblick: only what they draw, none of the messages it comes
from, which they would raise alerts about."""

from pathlib import Path

from mcap.records import Attachment, Metadata

from maniple.recording.mcap_file import MAGIC, McapFile
from maniple.recording.reader import Recording
from maniple.recording.selection import Selection
from maniple.recording.viz.export import EVERYTHING, ExportedFile, Pictures, new_file
from maniple.recording.writer import SCENARIO_NAME

METADATA_NAME = "maniple.viewer"
"""The metadata record that says which recording it comes from; not that of a recording."""

_CHUNK = 1 << 20


def export_foxglove(
    recording: Recording, out: Path, selection: Selection = EVERYTHING, force: bool = False
) -> ExportedFile:
    """Write what viewers draw of a recording into the MCAP file `out`. It is there whole or not at all. The
    same recording makes the same bytes.

    Raises:
        ArgumentError: `out` exists, and is no earlier export or not to be replaced.
        RecordingError: the recording is damaged, or its scenario can't be read.
        ManipleError: the file can't be written.
    """
    pictures = Pictures(recording, selection)
    with new_file(out, force, "Foxglove", _is_export) as new, new.open("xb", buffering=0) as raw:
        mcap = McapFile(raw, "maniple", compress=True)
        start = recording.start_ns
        mcap.add_metadata(Metadata(METADATA_NAME, dict(recording.metadata)))
        mcap.add_attachment(
            Attachment(start, start, SCENARIO_NAME, "application/json", recording.scenario_json)
        )
        schemas: dict[str, int] = {}
        for one in pictures.channels:
            if one.schema_name not in schemas:
                schemas[one.schema_name] = mcap.add_schema(one.schema_name, one.schema_encoding, one.schema)
        buffers = {
            one.key: mcap.add_channel(one.key, one.encoding, schemas[one.schema_name], {})
            for one in pictures.channels
        }
        for key, data, time in pictures:
            buffer = buffers[key]
            mcap.add_message(buffer, time, time, buffer.messages + len(buffer.index) // 2, data)
            if mcap.buffered > _CHUNK:
                mcap.flush()
        mcap.finish()
    return pictures.exported(out, "foxglove")


def _is_export(first_bytes: bytes) -> bool:
    """Its metadata is what a file has first."""
    return first_bytes.startswith(MAGIC) and METADATA_NAME.encode() in first_bytes
