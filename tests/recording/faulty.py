"""A short virtual run with every kind of thing in its recording."""

from pathlib import Path

from msgspec.structs import replace

import maniple
from maniple.cli.loading import load
from maniple.core.scenario.types import Crash, Fault, Freeze, Partition
from maniple.recording.reader import Recording, read


def faulty_run(folder: Path) -> Recording:
    """Six robots for 12 s, with loss and duplicates, a partition, a frozen controller, a robot that dies and
    comes back."""
    scenario = replace(
        load(Path("scenarios/chaos.toml"), (), 3),
        faults=(
            Fault(loss=0.2, duplicate=0.1, jitter_s=0.05),
            Fault(topic="robot/*/command", windows=((1.0, 2.0),)),
        ),
        partitions=(Partition(groups=(("r6",),), at_s=3.0, for_s=1.0),),
        crashes=(Crash(node="r2", at_s=5.0, restart_after_s=2.0),),
        freezes=(Freeze(node="controller", at_s=9.0, for_s=0.7),),
    )
    maniple.run(scenario, virtual=True, duration_s=12, log=folder / "run.mcap")
    return read(folder / "run.mcap")
