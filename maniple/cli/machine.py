"""What this machine is, as far as it matters to reproduce a run."""

import platform

import numpy as np

from maniple.core.scenario.types import Scenario
from maniple.core.version import __version__


def describe_machine(scenario: Scenario, mode: str) -> dict[str, str]:
    """What a recording says of where it comes from: no path, no wall-clock time, no installed extra."""
    found = np.show_config(mode="dicts")
    simd = found.get("SIMD Extensions", {}) if isinstance(found, dict) else {}
    return {
        "maniple": __version__,
        "scenario": scenario.name,
        "mode": mode,
        "seed": str(scenario.seed),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "machine": platform.machine(),
        "cpu_features": " ".join([*simd.get("baseline", []), *simd.get("found", [])]),
    }
