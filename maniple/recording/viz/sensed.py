"""Scans as Foxglove draws them: as a fan of ranges, and as points."""

from functools import lru_cache

import numpy as np
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from numpy.typing import NDArray

from maniple.core.geometry import Floats
from maniple.core.messages import Scan, unpack_floats
from maniple.core.time import Time
from maniple.recording.viz.basics import pose, sensor_frame, timestamp, wire

STRIDE = 12
"""Bytes of a point: x, y, z as float32."""

_FIELDS = tuple(
    PackedElementField(name=name, offset=4 * index, type=PackedElementField.FLOAT32)
    for index, name in enumerate("xyz")
)


def laser_scan(robot: str, scan: Scan, time: Time) -> bytes | None:
    """A scan of an even fan as `foxglove.LaserScan` in the frame of the sensor; infinite where nothing was
    seen. None for an array of sonars, or fewer than two beams."""
    ranges = np.frombuffer(scan.ranges, dtype="<f4")
    if scan.beams or len(ranges) < 2:
        return None
    return wire(
        LaserScan(
            timestamp=timestamp(time),
            frame_id=sensor_frame(robot),
            pose=pose(0.0, 0.0),
            start_angle=scan.first_angle_rad,
            end_angle=scan.first_angle_rad + scan.increment_rad * (len(ranges) - 1),
            ranges=np.where(ranges < scan.range_max_m, ranges, np.inf).tolist(),
        )
    )


def point_cloud(robot: str, scan: Scan, time: Time) -> bytes:
    """What a scan saw as `foxglove.PointCloud` in the frame of the sensor, on the axis of each cone."""
    points = points_of(scan)
    spatial = np.zeros((len(points), 3), dtype="<f4")
    spatial[:, :2] = points
    return wire(
        PointCloud(
            timestamp=timestamp(time),
            frame_id=sensor_frame(robot),
            pose=pose(0.0, 0.0),
            point_stride=STRIDE,
            fields=_FIELDS,
            data=spatial.tobytes(),
        )
    )


def points_of(scan: Scan) -> Floats:
    """Where a scan saw something, (k, 2), m, in the frame of the sensor."""
    ranges = np.frombuffer(scan.ranges, dtype="<f4")
    if scan.beams:
        beams = unpack_floats(scan.beams, 3)[: len(ranges)]
        ranges = ranges[: len(beams)]
        starts, directions = beams[:, :2], _directions(beams[:, 2])
    else:
        starts, directions = None, _fan(scan.first_angle_rad, scan.increment_rad, len(ranges))
    seen = ranges < scan.range_max_m
    points = directions[seen] * np.maximum(ranges[seen], 0.0)[:, None]
    return np.asarray(points if starts is None else points + starts[seen])


@lru_cache(maxsize=256)
def _fan(first: float, increment: float, count: int) -> Floats:
    return _directions(first + increment * np.arange(count, dtype=np.float64))


def _directions(angles: NDArray[np.float64]) -> Floats:
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)
