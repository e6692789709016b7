"""The project's scenes run as they did: today's runs against the recordings in `references/`."""

from pathlib import Path

import pytest

from tests.references.scenes import REFERENCES, Reference, check

LARGEST, ALL = 150_000, 1_000_000
"""Bytes of one reference, and of all."""

QUICK = ("paper-simulation-2", "chaos")
"""Those that are compared every time: the paper's second, and one in which everything goes wrong."""


@pytest.mark.parametrize(
    "reference",
    [
        pytest.param(one, id=one.name, marks=[] if one.name in QUICK else [pytest.mark.slow])
        for one in REFERENCES
    ],
)
def test_a_scene_runs_as_it_did(reference: Reference, tmp_path: Path) -> None:
    check(reference, tmp_path)


def test_a_gain_that_is_one_percent_off_is_found(tmp_path: Path) -> None:
    chaos = next(reference for reference in REFERENCES if reference.name == "chaos")
    with pytest.raises(AssertionError, match=r"maniple log diff .*chaos\.mcap .*--plot "):
        check(chaos, tmp_path, "controller.kappa=0.2525")


def test_references_are_small() -> None:
    sizes = [reference.path.stat().st_size for reference in REFERENCES]
    assert max(sizes) < LARGEST
    assert sum(sizes) < ALL
