"""What an agent's traffic costs without an agent: `python -m benchmarks.bare_agent ENDPOINT PREFIX ROBOT`.

A Zenoh client, with NumPy and msgspec imported, that hears what the agent of a robot hears and for each
motion puts as many bytes as an odometry and a drive, for each scan those of the scan. `sink` as robot is
the client that takes them, since what nobody hears is never sent.
"""

import json
import sys
from queue import SimpleQueue

import msgspec
import numpy as np
import zenoh

OWN = "bare"
"""Prefix of what it puts."""
ODOMETRY, DRIVE = bytes(150), bytes(80)


def main(endpoint: str, prefix: str, robot: str) -> None:
    """Go on until killed; say so when it begins."""
    with zenoh.open(_config(endpoint)) as session:
        kept = _sink(session) if robot == "sink" else _agent(session, f"{prefix}/hw/{robot}", prefix, robot)
        print("ready", len(kept), np.__name__, msgspec.__name__, flush=True)
        SimpleQueue[None]().get()


def _agent(session: zenoh.Session, wired: str, prefix: str, robot: str) -> list[object]:
    odometry, drive, ranges = (session.declare_publisher(f"{OWN}/{name}") for name in ("o", "d", "r"))

    def on_motion(_sample: zenoh.Sample) -> None:
        odometry.put(ODOMETRY)
        drive.put(DRIVE)

    def on_scan(sample: zenoh.Sample) -> None:
        ranges.put(sample.payload.to_bytes())

    return [
        session.declare_subscriber(f"{wired}/motion", on_motion),
        session.declare_subscriber(f"{wired}/scan", on_scan),
        session.declare_subscriber(f"{prefix}/robot/{robot}/command", _ignore),
    ]


def _sink(session: zenoh.Session) -> list[object]:
    return [session.declare_subscriber(f"{OWN}/*", _ignore)]


def _ignore(_sample: zenoh.Sample) -> None:
    pass


def _config(endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps("client"))
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")
    return config


if __name__ == "__main__":
    main(*sys.argv[1:])
