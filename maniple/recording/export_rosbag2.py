"""A recording as a rosbag2: what `maniple bridge ros2` would have published, for `ros2 bag play`, RViz,
PlotJuggler and whoever else reads bags. Needs rosbags; importing this imports it."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_typestore

from maniple.core.errors import ManipleError
from maniple.recording.export_tables import new_folder
from maniple.recording.reader import Recording
from maniple.recording.ros2 import Names, Said, Topic, Translation
from maniple.recording.selection import Selection
from maniple.recording.viz.export import EVERYTHING, Derived, ExportedFile, epoch_of

SCENARIO = "maniple-scenario.json"
"""The parameters of the run; it marks the folder as one of ours."""

VERSION: Literal[9] = 9
"""Of the format of metadata.yaml: since Jazzy."""

_FOREVER = QosTime(9_223_372_036, 854_775_807)
"""As ROS 2 says that there is no limit."""


def export_rosbag2(
    recording: Recording,
    out: Path,
    selection: Selection = EVERYTHING,
    force: bool = False,
) -> ExportedFile:
    """Write a recording as the bag `out`, a folder with an MCAP file and metadata.yaml. It is there whole or
    not at all. Stamps and times of the bag are log times.

    Raises:
        ArgumentError: `out` exists, and is no earlier export or not to be replaced.
        ScenarioError: two robots would have the same name in ROS 2.
        RecordingError: the recording is damaged, or its scenario can't be read.
        ManipleError: the bag can't be written.
    """
    scenario = recording.scenario
    said = Derived(recording, selection, Translation(scenario, Names(scenario), epoch_of(recording)))
    with new_folder(out, force, SCENARIO) as folder:
        bag = folder / out.name
        try:
            _write(bag, recording.metadata, said)
        except WriterError as error:
            raise ManipleError(f"{out}: can't write the bag: {error}") from None
        for file in bag.iterdir():
            file.rename(folder / file.name)
        bag.rmdir()
        (folder / SCENARIO).write_bytes(recording.scenario_json)
    return said.exported(out, "rosbag2")


def _write(bag: Path, metadata: Mapping[str, str], messages: Iterable[Said]) -> None:
    types = get_typestore(Stores.ROS2_JAZZY)
    connections: dict[str, Connection] = {}
    writer = Writer(bag, version=VERSION, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        for key, value in metadata.items():
            writer.set_custom_data(f"maniple.{key}", value)
        for topic, message, time in messages:
            connection = connections.get(topic.name)
            if connection is None:
                connection = connections[topic.name] = writer.add_connection(
                    topic.name, topic.type, typestore=types, offered_qos_profiles=[_qos(topic)]
                )
            writer.write(connection, time, types.serialize_cdr(message, topic.type))


def _qos(topic: Topic) -> Qos:
    """Reliable; what is latched is given to late subscribers when the bag is played, too."""
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=topic.depth,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if topic.latched else QosDurability.VOLATILE,
        deadline=_FOREVER,
        lifespan=_FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )
