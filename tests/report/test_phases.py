"""The figure of phases knows everything a platoon can be doing."""

from typing import get_args

from maniple.core.messages import Mode, Phase
from maniple.report.phases import BANDS


def test_every_phase_and_mode_has_a_band_of_its_own() -> None:
    assert {*get_args(Phase), *get_args(Mode)} <= BANDS.keys()
    looks = [BANDS[mode] for mode in get_args(Mode)]
    assert len(set(looks)) == len(looks)
