"""The reference waits for robots that can't keep up."""

from maniple.core.scenario.types import Waiting


def rate(parameters: Waiting, error_m: float) -> float:
    """How fast the reference moves along its task, from 1 as planned to 0, while the robot that is farthest
    from its place is `error_m` from it."""
    if not parameters.enabled:
        return 1.0
    share = (parameters.stop_m - error_m) / (parameters.stop_m - parameters.free_m)
    return min(max(share, 0.0), 1.0)
