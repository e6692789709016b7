"""The parameters of a presented rover: those of ArduPilot Rover that a ground station asks for, with its
defaults. All but those marked have the effect that they have there."""

from collections.abc import Mapping
from typing import NamedTuple

INT8, INT16, INT32, REAL32 = 2, 4, 6, 9
"""MAV_PARAM_TYPE."""

GNSS, EXTERNAL = 3, 6
"""Sources of EK3_SRC1_POSXY."""


class Parameter(NamedTuple):
    """One parameter."""

    type: int
    default: float
    least: float
    most: float


def parameters_of(gcs_system_id: int, external_pose: bool) -> Mapping[str, Parameter]:
    """All of them, by name, in the order of their indices."""
    source = EXTERNAL if external_pose else GNSS
    return {
        "ATC_ACCEL_MAX": Parameter(REAL32, 1.0, 0.0, 10.0),
        "ATC_DECEL_MAX": Parameter(REAL32, 0.0, 0.0, 10.0),
        "ATC_STR_ANG_P": Parameter(REAL32, 2.0, 1.0, 10.0),
        "ATC_STR_RAT_MAX": Parameter(REAL32, 120.0, 0.0, 1000.0),
        "EK3_SRC1_POSXY": Parameter(INT8, source, 0, 6),  # this one and the next say how it was built
        "EK3_SRC1_VELXY": Parameter(INT8, source, 0, 6),
        "EK3_SRC1_YAW": Parameter(INT8, 1, 0, 8),  # no effect: its compass is true
        "FS_ACTION": Parameter(INT8, 2, 0, 5),
        "FS_GCS_ENABLE": Parameter(INT8, 0, 0, 2),
        "FS_GCS_TIMEOUT": Parameter(REAL32, 5.0, 2.0, 120.0),
        "FS_TIMEOUT": Parameter(REAL32, 1.5, 1.0, 100.0),
        "MAV_GCS_SYSID": Parameter(INT16, gcs_system_id, 1, 255),
        "MAV_OPTIONS": Parameter(INT16, 0, 0, 1),
        "RC_OVERRIDE_TIME": Parameter(REAL32, 3.0, -1.0, 120.0),
        "VISO_TYPE": Parameter(INT8, 3 if external_pose else 0, 0, 4),
        "WP_SPEED": Parameter(REAL32, 2.0, 0.0, 100.0),
    }
