"""A part of a platoon as a recorder hears it: some robots, and what simulator and controller say of them,
each in a session of its own.

Its arguments: the endpoint, the prefix, names of robots with commas between, seconds of calm, of a burst of
ten times as much, and of calm again. Prints how many messages it has sent, by topic, as JSON.
"""

import sys
import time
from collections import Counter
from contextlib import ExitStack

import msgspec
import numpy as np

from maniple.core import codec, messages, topics
from maniple.core.time import MILLISECOND
from maniple.transport.zenoh import ZenohSession

STEP_S = 0.05
"""20 Hz."""
BURST = 10
BEAMS = 361


def main(endpoint: str, prefix: str, names: str, calm_s: str, burst_s: str, after_s: str) -> None:
    """Say it all, at its times: a message that is late is said at once, none is left out."""
    robots = names.split(",")
    rng = np.random.default_rng(len(names))
    scans = [messages.pack_floats(rng.uniform(0.1, 8.0, BEAMS)) for _ in range(16)]
    sent: Counter[str] = Counter()
    with ExitStack() as stack:
        sessions = {
            name: stack.enter_context(ZenohSession.client(endpoint, prefix))
            for name in (*robots, "simulator", "controller")
        }
        for session in sessions.values():
            session.settle()
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.readline()
        due, step = time.monotonic(), 0
        for span_s, factor in ((calm_s, 1), (burst_s, BURST), (after_s, 1)):
            for _ in range(round(float(span_s) / STEP_S) * factor):
                for topic, source, message in _said(robots, scans, step):
                    data = codec.encode(
                        msgspec.structs.replace(
                            message, source=source, incarnation=1, seq=sent[topic], stamp_ns=time.time_ns()
                        )
                    )
                    sessions[source].put(topic, data)
                    sent[topic] += 1
                step += 1
                due += STEP_S / factor
                time.sleep(max(due - time.monotonic(), 0.0))
        late_s = time.monotonic() - due
        for session in sessions.values():
            session.settle()
    sys.stdout.write(msgspec.json.encode({"sent": sent, "late_s": late_s}).decode() + "\n")
    sys.stdout.flush()


def _said(robots: list[str], scans: list[bytes], step: int) -> list[tuple[str, str, messages.Message]]:
    """What is said in one step of 50 ms."""
    made: list[tuple[str, str, messages.Message]] = []
    answers = messages.Stamp(1, step, step * 50 * MILLISECOND)
    for number, robot in enumerate(robots):
        x = 0.01 * step
        scan = messages.Scan(
            first_angle_rad=-np.pi,
            increment_rad=2 * np.pi / (BEAMS - 1),
            range_min_m=0.0,
            range_max_m=8.0,
            mount=(0.0, 0.0, 0.0),
            ranges=scans[(step + number) % len(scans)],
        )
        odometry = messages.Odometry(
            frame_id=f"{robot}/1", x_m=x, y_m=0.0, psi_rad=0.1, u_mps=0.2, w_radps=0.0, applied=answers
        )
        motion = messages.Motion(ticks=(step, step), applied=(0.2, 0.0), state="active", controllable=True)
        command = messages.Command(layer="drive", values=(0.2, 0.0), answers=answers, inputs_age_ns=step)
        made += [
            (topics.odometry(robot), robot, odometry),
            (topics.drive(robot), robot, messages.Drive(u_mps=0.2, w_radps=0.0, active=True)),
            (topics.motion(robot), "simulator", motion),
            (topics.scan(robot), "simulator", scan),
            (topics.ranges(robot), robot, scan),
            (topics.command(robot), "controller", command),
        ]
        if step % 4 == 0:
            calls = tuple(
                messages.Call("message", step + i, topics.motion(robot), "simulator", 1, step, 7 * i)
                for i in range(16)
            )
            made.append((topics.journal(robot), robot, messages.Journal(calls=calls)))
    return made


if __name__ == "__main__":
    main(*sys.argv[1:])
