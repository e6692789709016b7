"""Measured networks: what a rule of faults does when it names one. docs/faults.md has the sources, and what
is estimated.

All delays are one way: half of the round trips that were measured. Where the 90th percentile of these is
known, as many messages are held back (`reorder`) as give that.
"""

from collections.abc import Mapping
from types import MappingProxyType

from msgspec.structs import replace

from maniple.core.errors import ScenarioError
from maniple.core.scenario.types import Burst, Fault

PRESETS: Mapping[str, Fault] = MappingProxyType(
    {
        "wifi-good": Fault(latency_s=0.0015, jitter_s=0.001, loss=0.001, reorder=0.055, reorder_s=0.018),
        "wifi-crowded": Fault(
            latency_s=0.010,
            jitter_s=0.008,
            burst=Burst(enter=0.005, leave=0.3),
            reorder=0.055,
            reorder_s=0.1,
        ),
        "lte": Fault(
            latency_s=0.035,
            jitter_s=0.010,
            loss=0.0005,
            burst=Burst(enter=0.0005, leave=0.1),
            rate_kbps=6000.0,
        ),
        "mesh-2-hops": Fault(latency_s=0.010, jitter_s=0.005, loss=0.02, rate_kbps=800.0),
        "mesh-3-hops": Fault(latency_s=0.015, jitter_s=0.008, loss=0.03, rate_kbps=550.0),
        "satellite-leo": Fault(
            latency_s=0.025, jitter_s=0.015, loss=0.002, burst=Burst(enter=0.001, leave=0.1)
        ),
        "satellite-geo": Fault(latency_s=0.300, jitter_s=0.020, loss=0.005),
    }
)

FIELDS = (
    "latency_s",
    "jitter_s",
    "loss",
    "burst",
    "duplicate",
    "reorder",
    "reorder_s",
    "corrupt",
    "rate_kbps",
    "queue_s",
)
"""What a preset gives where a rule leaves it at its default."""

_DEFAULT = Fault()


def with_preset(rule: Fault) -> Fault:
    """The rule with the numbers of its preset where it has defaults; itself where it names none. Doing it
    again changes nothing.

    Raises:
        ScenarioError: there is no such preset.
    """
    if not rule.preset:
        return rule
    preset = PRESETS.get(rule.preset)
    if preset is None:
        raise ScenarioError(f"preset = {rule.preset!r}: must be one of {', '.join(PRESETS)}")
    return replace(
        rule,
        **{name: getattr(preset, name) for name in FIELDS if getattr(rule, name) == getattr(_DEFAULT, name)},
    )
