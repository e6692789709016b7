"""The scene of the deployment tests: the first simulation of the paper, its first obstacles only, and robots
that stand before a cut of 5 s is over."""

from pathlib import Path

from tests.cli.scenes import PAPER

ROBOTS = ("r1", "r2", "r3", "r4", "r5", "r6")


def write(folder: Path, length_m: float = 5.0) -> Path:
    """The scenario as a file."""
    text = PAPER.read_text()
    for old, new in (
        ("end = [15.0, 0.0]", f"end = [{length_m}, 0.0]"),
        ("settle_s = 15.0", "settle_s = 10.0"),
        ("[guard]\n", "[guard]\nstop_after_s = 3.5\n"),
    ):
        assert old in text
        text = text.replace(old, new)
    path = folder / "scene.toml"
    path.write_text(text)
    return path
