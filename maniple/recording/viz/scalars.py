"""Numbers for plots, as JSON. What is not known is left out."""

from typing import Any

import msgspec
from msgspec import UNSET, UnsetType

from maniple.core.geometry import Floats

Known = float | UnsetType
Told = str | UnsetType


class FormationScalars(msgspec.Struct):
    """The formation as the controller sees it; errors are the largest over the triangles."""

    phase: str
    rate: float
    """How fast the reference moves along the task: 1 as planned, 0 it stands."""
    task_time_s: float
    robots: int
    """In the chain."""
    waited_for: int
    """Robots that the reference waits for."""
    position_m: Known = UNSET
    """Of the centroid."""
    orientation_rad: Known = UNSET
    """psi_F."""
    distance_m: Known = UNSET
    """p and q, whichever is off more."""
    angle_rad: Known = UNSET
    """beta."""


class TriangleScalars(msgspec.Struct):
    """The errors of one triangle, desired minus estimated."""

    robots: str
    x_m: float
    y_m: float
    psi_rad: float
    p_m: float
    q_m: float
    beta_rad: float


class RobotScalars(msgspec.Struct):
    """One robot."""

    u_mps: Known = UNSET
    """By its odometry."""
    w_radps: Known = UNSET
    v_mps: Known = UNSET
    """Sideways; of a robot that can."""
    u_commanded_mps: Known = UNSET
    """What its drive was told, after the guard."""
    w_commanded_radps: Known = UNSET
    v_commanded_mps: Known = UNSET
    command_age_s: Known = UNSET
    """Of what its command was computed from, by its own clock."""
    command_age_max_s: Known = UNSET
    """The largest since the status before."""
    odometry_age_s: Known = UNSET
    """As far as the controller can tell."""
    round_trip_s: Known = UNSET
    """Of a command and an odometry back."""
    clearance_m: Known = UNSET
    """Ground truth: smallest distance to anything since the sample before."""
    mode: Told = UNSET
    guard: Told = UNSET
    """Which limit the guard applied last."""
    state: Told = UNSET
    """What the controller takes it for: "present", "silent", "lost", ..."""


encode = msgspec.json.Encoder().encode


def measured(value: float) -> Known:
    """An age, where there is one: -1 on the wire is none."""
    return value if value >= 0.0 else UNSET


def largest(errors: Floats) -> tuple[float, float, float, float]:
    """Errors (m, 6) of triangles as the largest of position, orientation, distances and angle."""
    x, y, psi, p, q, beta = abs(errors).T
    return (
        float((x * x + y * y).max()) ** 0.5,
        float(psi.max()),
        float(max(p.max(), q.max())),
        float(beta.max()),
    )


def schema_of(kind: type[msgspec.Struct]) -> bytes:
    """The JSON schema of a struct, with nothing that refers to another place."""
    schema: dict[str, Any] = msgspec.json.schema(kind)
    return msgspec.json.encode(schema["$defs"][kind.__name__])
