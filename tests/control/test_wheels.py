import math
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from maniple.control.wheels import OMNI_WHEELS, wheel_ways
from maniple.core.geometry import Pose
from tests.pioneer import PIONEER

CONTACTS = {
    "differential": [Pose(0.0, side * 0.165, 0.0) for side in (-1, 1)],
    "car": [Pose(0.0, side * 0.165, 0.0) for side in (-1, 1)],
    "omnidirectional": [
        Pose(0.165 * math.cos(angle), 0.165 * math.sin(angle), angle + math.pi / 2) for angle in OMNI_WHEELS
    ],
}
"""Where each wheel touches the ground, and which way it rolls."""


@pytest.mark.parametrize("drive", CONTACTS)
def test_each_wheel_rolls_as_its_contact_moves(drive: str) -> None:
    extra: dict[str, Any] = {"v_max_mps": 1.0} if drive == "omnidirectional" else {}
    ways = wheel_ways(replace(PIONEER, drive=drive, **extra), 0.33)
    u, w, v, dt = 0.4, -0.8, 0.3, 1e-6
    contacts = CONTACTS[drive]
    if drive != "omnidirectional":  # left first
        contacts = contacts[::-1]
        v = 0.0
    for way, contact in zip(ways, contacts, strict=True):
        before, after = (Pose(k * u * dt, k * v * dt, k * w * dt).compose(contact) for k in (-1, 1))
        moved = np.array([after.x - before.x, after.y - before.y]) / (2 * dt)
        rolls = (math.cos(contact.psi), math.sin(contact.psi))
        assert way @ (u, w, v) == pytest.approx(moved @ rolls, abs=1e-8)
    squares = ways.T @ ways
    assert squares == pytest.approx(np.diag(np.diag(squares)), abs=1e-12)
