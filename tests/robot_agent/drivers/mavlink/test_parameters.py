"""Which parameters of a vehicle are good enough."""

import re

import pytest

from robot_agent.drivers.mavlink.parameters import Needs, advice, refused

NEEDS = Needs(u_max_mps=0.75, w_max_radps=1.7, brake_mps2=0.6, gcs_system_id=255, external_pose=False)
FED = NEEDS._replace(external_pose=True)
GOOD = {"WP_SPEED": 2.0, "FS_GCS_ENABLE": 1.0, "MAV_GCS_SYSID": 255.0, "MAV_OPTIONS": 1.0}
FED_GOOD = GOOD | {"VISO_TYPE": 3.0, "EK3_SRC1_POSXY": 6.0, "EK3_SRC1_YAW": 6.0}


def test_good_ones_and_none_at_all() -> None:
    assert refused(GOOD, NEEDS) == refused({}, NEEDS) == refused(FED_GOOD, FED) == refused({}, FED) == ""
    assert advice(GOOD, NEEDS) == advice(FED_GOOD, FED) == []


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"WP_SPEED": 0.5}, "its WP_SPEED is 0.5 m/s, .* at least u_max_mps = 0.75"),
        ({"ATC_STR_RAT_MAX": 90.0}, r"ATC_STR_RAT_MAX is 90 degrees/s, .* at least 97.4, w_max_radps = 1.7"),
        ({"ATC_ACCEL_MAX": 0.5}, "ATC_ACCEL_MAX is 0.5 m/s.2, .* at least brake_mps2 = 0.6"),
        ({"ATC_DECEL_MAX": 0.4}, "ATC_DECEL_MAX is 0.4 m/s.2"),
        ({"MAV_GCS_SYSID": 77.0}, "obeys system id 77 only, and mavlink.gcs_system_id is 255"),
        ({"VISO_TYPE": 0.0}, "its VISO_TYPE is 0, so it takes no external pose"),
        ({"EK3_SRC1_POSXY": 3.0}, "its EK3_SRC1_POSXY is 3, .* must be 6"),
    ],
)
def test_what_is_refused_says_what_would_do(changed: dict[str, float], words: str) -> None:
    assert re.search(words, refused(FED_GOOD | changed, FED))


@pytest.mark.parametrize(
    "changed",
    [
        {"ATC_STR_RAT_MAX": 0.0},
        {"ATC_STR_RAT_MAX": 120.0},
        {"ATC_ACCEL_MAX": 0.5, "ATC_DECEL_MAX": 1.0},
        {"ATC_ACCEL_MAX": 0.0, "ATC_DECEL_MAX": 0.0},
    ],
)
def test_limits_that_are_none_or_wide_enough(changed: dict[str, float]) -> None:
    assert refused(GOOD | changed, NEEDS) == ""


def test_the_old_names_mean_the_same() -> None:
    old = {"WP_SPEED": 2.0, "SYSID_MYGCS": 77.0, "SYSID_ENFORCE": 1.0}
    assert "obeys system id 77 only" in refused(old, NEEDS)
    assert refused(old | {"SYSID_ENFORCE": 0.0}, NEEDS) == ""


def test_advice() -> None:
    lines = advice({"FS_GCS_ENABLE": 0.0, "MAV_GCS_SYSID": 77.0, "MAV_OPTIONS": 0.0}, NEEDS)
    assert len(lines) == 3
    assert lines[0].startswith("FS_GCS_ENABLE = 0")
    assert "system id 77" in lines[1]
    assert "anybody" in lines[2]
    assert "EK3_SRC1_YAW" in advice(FED_GOOD | {"EK3_SRC1_YAW": 1.0}, FED)[0]
