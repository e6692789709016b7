"""Which of a vehicle's parameters matter to a platoon, and what they have to be."""

import math
from collections.abc import Mapping
from typing import NamedTuple

ALWAYS = (
    "WP_SPEED",
    "ATC_STR_RAT_MAX",
    "ATC_ACCEL_MAX",
    "ATC_DECEL_MAX",
    "FS_GCS_ENABLE",
    "MAV_GCS_SYSID",
    "SYSID_MYGCS",
    "MAV_OPTIONS",
    "SYSID_ENFORCE",
)
SAME = {"SYSID_MYGCS": "MAV_GCS_SYSID", "SYSID_ENFORCE": "MAV_OPTIONS"}
SAME |= {new: old for old, new in SAME.items()}
"""The two names of one thing: the second ones came with ArduPilot 4.7."""
EXTERNAL = ("EK3_SRC1_POSXY", "EK3_SRC1_YAW", "VISO_TYPE")
"""Of a vehicle that is fed with its position."""

_FROM_GCS_ONLY = 1
_EXTERNAL_NAVIGATION = 6
_CLIP = 1e-3


class Needs(NamedTuple):
    """What a scenario asks of them."""

    u_max_mps: float
    w_max_radps: float
    brake_mps2: float
    gcs_system_id: int
    external_pose: bool

    @property
    def names(self) -> tuple[str, ...]:
        """Those to read."""
        return ALWAYS + (EXTERNAL if self.external_pose else ())


def refused(values: Mapping[str, float], needs: Needs) -> str:
    """Why the vehicle can't be used as it is set up; empty where it can. What it does not have is nothing
    to complain of."""
    speed = values.get("WP_SPEED")
    if speed is not None and speed < needs.u_max_mps - _CLIP:
        return (
            f"its WP_SPEED is {speed:g} m/s, and it drives no faster whatever it is told; must be at least "
            f"u_max_mps = {needs.u_max_mps:g} of the robot's model (set WP_SPEED, or lower u_max_mps)"
        )
    turning = math.radians(values.get("ATC_STR_RAT_MAX", 0.0))
    if 0.0 < turning < needs.w_max_radps - _CLIP:
        return (
            f"its ATC_STR_RAT_MAX is {math.degrees(turning):g} degrees/s, and it turns no faster; must be at "
            f"least {math.degrees(needs.w_max_radps):.1f}, w_max_radps = {needs.w_max_radps:g} of the "
            "robot's model, or 0 for no limit"
        )
    name = "ATC_DECEL_MAX" if values.get("ATC_DECEL_MAX", 0.0) > 0.0 else "ATC_ACCEL_MAX"
    if 0.0 < values.get(name, 0.0) < needs.brake_mps2 - _CLIP:
        return (
            f"its {name} is {values[name]:g} m/s^2, and it brakes no harder; must be at least brake_mps2 = "
            f"{needs.brake_mps2:g} of the robot's model, on which the guard relies"
        )
    heeded = _heeded(values)
    if _enforced(values) and heeded is not None and heeded != needs.gcs_system_id:
        return (
            f"it obeys system id {heeded} only, and mavlink.gcs_system_id is {needs.gcs_system_id}; "
            "they must be the same"
        )
    if not needs.external_pose:
        return ""
    if values.get("VISO_TYPE") == 0:
        return "its VISO_TYPE is 0, so it takes no external pose; must be 1 (MAVLink) or 3 (VOXL)"
    source = values.get("EK3_SRC1_POSXY")
    if source is not None and source != _EXTERNAL_NAVIGATION:
        return (
            f"its EK3_SRC1_POSXY is {source:g}, so it does not go by the external pose; must be "
            f"{_EXTERNAL_NAVIGATION} (external navigation)"
        )
    return ""


def advice(values: Mapping[str, float], needs: Needs) -> list[str]:
    """What is allowed, and had better be otherwise."""
    said = []
    if values.get("FS_GCS_ENABLE") == 0:
        said.append(
            "FS_GCS_ENABLE = 0: it does nothing by itself when the controller is gone; 1 makes it hold"
        )
    heeded = _heeded(values)
    if heeded is not None and heeded != needs.gcs_system_id:
        said.append(
            f"its failsafe waits for system id {heeded}, and mavlink.gcs_system_id is {needs.gcs_system_id}"
        )
    if not _enforced(values):
        said.append("anybody on its network may command it: set bit 0 of MAV_OPTIONS (or SYSID_ENFORCE)")
    if needs.external_pose and values.get("EK3_SRC1_YAW", _EXTERNAL_NAVIGATION) != _EXTERNAL_NAVIGATION:
        said.append("EK3_SRC1_YAW is not 6: its heading comes from elsewhere than its position")
    return said


def _heeded(values: Mapping[str, float]) -> int | None:
    """The system id it takes for its ground station."""
    value = values.get("MAV_GCS_SYSID", values.get("SYSID_MYGCS"))
    return None if value is None else round(value)


def _enforced(values: Mapping[str, float]) -> bool:
    """Whether it obeys no other."""
    return bool(int(values.get("MAV_OPTIONS", 0)) & _FROM_GCS_ONLY or values.get("SYSID_ENFORCE", 0) == 1)
