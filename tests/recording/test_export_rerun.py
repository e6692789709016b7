"""What Rerun's own readers find: in what is exported for it, and in an MCAP file with viewer channels."""

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms

from maniple.core.errors import ArgumentError, ManipleError
from maniple.core.time import SECOND
from maniple.recording.export_foxglove import export_foxglove
from maniple.recording.reader import read
from maniple.recording.selection import Selection
from tests.recording.viz.pictures import drawn, recorded

pytest.importorskip("rerun", reason="needs the extra rerun (170 MB), part of the extra dev")

import rerun as rr
from rerun.chunk import Chunk, LazyChunkStream, McapReader, RrdReader

from maniple.recording.export_rerun import TIMELINE, export_rerun


def chunks(stream: LazyChunkStream) -> dict[str, list[Chunk]]:
    """The chunks of each entity that have data on a timeline, or hold all the time."""
    found: defaultdict[str, list[Chunk]] = defaultdict(list)
    for chunk in stream:
        found[str(chunk.entity_path)].append(chunk)
    return found


def column(of: list[Chunk], name: str) -> list[np.ndarray]:
    """The values of a component, row by row."""
    rows = []
    for chunk in of:
        batch = chunk.to_record_batch()
        if name in batch.schema.names:
            rows += [np.array(row) for row in batch.column(name).to_pylist() if row is not None]
    return rows


def components(of: list[Chunk]) -> set[str]:
    return {name for chunk in of for name in chunk.to_record_batch().schema.names if ":" in name}


def test_an_export_has_everything(tmp_path: Path) -> None:
    exported = export_rerun(read(recorded()), tmp_path / "a.rrd")
    assert exported.drawn == len(drawn())
    found = chunks(RrdReader(tmp_path / "a.rrd").stream())
    timelines = {name for of in found.values() for chunk in of for name in chunk.timeline_names}
    assert timelines == {TIMELINE}
    for robot in ("r1", "r2", "r3", "r4"):
        assert "Boxes3D:half_sizes" in components(found[f"/world/robots/{robot}/boxes"])
        assert "Points3D:labels" in components(found[f"/world/robots/{robot}/label"])
        assert "Points3D:positions" in components(found[f"/world/robots/{robot}/sensor/points"])
        assert "LineStrips3D:strips" in components(found[f"/world/trajectory/{robot}"])
        assert "LineStrips3D:strips" in components(found[f"/world/truth/{robot}/lines"])
        assert "Scalars:scalars" in components(found[f"/numbers/robot/{robot}/u_mps"])
        assert "StateChange:state" in components(found[f"/states/robot/{robot}/mode"])
    assert "LineStrips3D:strips" in components(found["/world/formation/actual/lines"])
    assert "Mesh3D:triangle_indices" in components(found["/world/formation/desired/triangles/0"])
    assert "Cylinders3D:radii" in components(found["/world/obstacles/obstacles/cylinders"])
    assert len(found["/world/obstacles/obstacles/cylinders"]) == 1
    texts = [
        str(row[0])
        for path in found
        if path.startswith("/log/")
        for row in column(found[path], "TextLog:text")
    ]
    assert "r2 is killed, back after 1 s" in texts


def test_frames_move_as_they_are_told(tmp_path: Path) -> None:
    export_rerun(read(recorded()), tmp_path / "a.rrd")
    found = chunks(RrdReader(tmp_path / "a.rrd").stream())
    told = {}
    for one in drawn():
        if one.key == "/viz/tf":
            for frame in FrameTransforms.FromString(one.data).transforms:
                if frame.child_frame_id == "r1":
                    at = frame.timestamp
                    told[at.seconds * SECOND + at.nanos] = (frame.translation.x, frame.translation.y, 0.0)
    places = [row[0] for row in column(found["/world/robots/r1"], "Transform3D:translation")]
    assert np.array(places) == pytest.approx(np.array([told[time] for time in sorted(told)]))
    times = np.concatenate(
        [chunk.to_record_batch().column(TIMELINE).to_numpy() for chunk in found["/world/robots/r1"]]
    )
    start = read(recorded()).start_ns
    assert times.astype(np.int64).tolist() == [time - start for time in sorted(told)]


def test_a_part_starts_where_it_is_asked_to(tmp_path: Path) -> None:
    recording = read(recorded())
    export_rerun(recording, tmp_path / "a.rrd", Selection(start_ns=recording.start_ns + 5 * SECOND))
    found = chunks(RrdReader(tmp_path / "a.rrd").stream())
    times = [
        chunk.to_record_batch().column(TIMELINE).to_numpy().astype(np.int64).min()
        for path, of in found.items()
        for chunk in of
        if TIMELINE in chunk.timeline_names and path.startswith("/numbers")
    ]
    assert min(times) >= 5 * SECOND


def test_nothing_is_overwritten_unless_asked(tmp_path: Path) -> None:
    out = tmp_path / "a.rrd"
    out.write_text("mine")
    with pytest.raises(ArgumentError, match="no earlier export to Rerun"):
        export_rerun(read(recorded()), out, force=True)
    assert out.read_text() == "mine"
    out.unlink()
    export_rerun(read(recorded()), out)
    with pytest.raises(ArgumentError, match="--force"):
        export_rerun(read(recorded()), out)
    export_rerun(read(recorded()), out, force=True)
    assert out.read_bytes().startswith(b"RRF")
    assert [path.name for path in tmp_path.iterdir()] == ["a.rrd"]


def test_rerun_that_is_turned_off_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(ManipleError, match="environment variable RERUN"):
        export_rerun(read(recorded()), tmp_path / "a.rrd")
    assert not [*tmp_path.iterdir()]


def test_what_rerun_could_not_write_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a full disk it goes on, and says so only if asked."""

    def fail(_: rr.RecordingStream) -> None:
        raise RuntimeError("File-writer thread shut down prematurely")

    monkeypatch.setattr(rr.RecordingStream, "flush", fail)
    with pytest.raises(ManipleError, match="can't write the export: File-writer"):
        export_rerun(read(recorded()), tmp_path / "a.rrd")
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("exported", [False, True], ids=["recording", "export"])
def test_rerun_draws_an_mcap_file_as_it_is(tmp_path: Path, exported: bool) -> None:
    """Frames, poses, points and the text log; not the scenes and scans of Foxglove, which it has no drawing
    for."""
    log = tmp_path / "a.mcap" if exported else recorded(viz=True)
    if exported:
        export_foxglove(read(recorded()), log)
    found = chunks(McapReader(log).stream())
    assert {"Transform3D:translation", "Transform3D:child_frame"} <= components(found["/viz/tf"])
    assert "Points3D:positions" in components(found["/viz/points/r1"])
    assert "InstancePoses3D:translations" in components(found["/viz/trajectory/r1"])
    assert "TextLog:text" in components(found["/viz/log"])
