import os
from pathlib import Path

import msgspec
import pytest

from maniple.cli.loading import completed, load, loads, range_finders, robot_models
from maniple.core.errors import ScenarioError
from maniple.core.scenario.parse import scenario_of, to_json

ROOT = Path(__file__).parents[2]
MINIMAL = """
name = "small"
task = { kind = "line", start = [0, 0], end = [3, 0], speed_mps = 0.1 }
formation.points = [[1, 0], [0, 0.8], [0, -0.8]]
robots = [{ id = "r1" }, { id = "r2" }, { id = "r3" }]
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(MINIMAL)
    return path


def test_a_file_is_read_resolved_and_checked(file: Path) -> None:
    scenario = load(file)
    assert scenario.name == "small"
    assert scenario.robots[0].pose == pytest.approx((0.8, 0, 0))
    assert set(scenario.models) == {"pioneer-3dx"}
    assert scenario.sensor_of(scenario.robots[0]).beams == 181


def test_overrides_and_seed(file: Path) -> None:
    scenario = load(file, ["robots.r2.control_point_m=0.3", "seed=5"], seed=7)
    assert scenario.robots[1].control_point_m == 0.3
    assert scenario.seed == 7


def test_json_is_read_by_its_suffix(file: Path, tmp_path: Path) -> None:
    scenario = load(file)
    copy = tmp_path / "copy.json"
    copy.write_bytes(to_json(scenario))
    assert load(copy) == scenario
    assert loads(to_json(scenario), form="json") == scenario
    assert load(copy, ["guard.clearance=false"]).guard.clearance is False


def test_a_scenario_from_python_is_completed_likewise(file: Path) -> None:
    bare = scenario_of(
        {
            "name": "small",
            "task": {"kind": "line", "start": [0, 0], "end": [3, 0], "speed_mps": 0.1},
            "formation": {"points": [[1, 0], [0, 0.8], [0, -0.8]]},
            "robots": [{"id": "r1"}, {"id": "r2"}, {"id": "r3"}],
        }
    )
    assert completed(bare) == load(file)
    with pytest.raises(ScenarioError, match="d_min_m"):
        completed(
            msgspec.structs.replace(bare, avoidance=msgspec.structs.replace(bare.avoidance, d_min_m=2.0))
        )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "name: missing; must be text"),
        (b"name = ", "not valid TOML: Invalid value (at "),
        (b"\x7fELF\x02\x01\x01\x00", "not valid TOML: "),
        (b"name = '\xff'", "not valid TOML: byte 8 (line 1) is not UTF-8 text"),
        (b"x = " + b"[" * 200_000, "not valid TOML: "),
        (b"#" * (16 * 2**20 + 1), "larger than 16 MiB: not a scenario"),
        (MINIMAL.encode() + b"[controller]\nkapa = 1", "controller.kapa: unknown field; valid: kappa"),
        (MINIMAL.encode().replace(b"r2", b"r1"), "robots[1].id = 'r1': robots[0] has it already"),
        (
            MINIMAL.encode().replace(b'"r2"', b'"r2", model = "tank"'),
            "robots[1].model = 'tank': must be one of ",
        ),
    ],
    ids=["empty", "syntax", "binary", "utf-8", "deep", "huge", "field", "duplicate", "model"],
)
def test_what_is_wrong_with_a_file(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(ScenarioError) as caught:
        load(path)
    lines = str(caught.value).splitlines()
    assert all(line.startswith(f"{path}: ") for line in lines)
    assert any(message in line for line in lines)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"nothing\.toml: can't be read: No such file or directory"):
        load(tmp_path / "nothing.toml")
    with pytest.raises(ScenarioError, match="can't be read: Is a directory"):
        load(tmp_path)
    with pytest.raises(ScenarioError, match="can't be read: embedded null"):
        load(Path("a\0b"))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read(file: Path) -> None:
    file.chmod(0)
    with pytest.raises(ScenarioError, match="can't be read: Permission denied"):
        load(file)


def test_an_endless_file_ends() -> None:
    with pytest.raises(ScenarioError, match="larger than 16 MiB"):
        load(Path("/dev/zero"))


def test_a_bad_override_names_the_file_too(file: Path) -> None:
    with pytest.raises(ScenarioError, match=r"small\.toml: override 'x': must be key=value"):
        load(file, ["x"])


def test_a_bad_seed_is_refused(file: Path) -> None:
    with pytest.raises(ScenarioError, match="seed = -1: must be a whole number >= 0"):
        load(file, seed=-1)


@pytest.mark.parametrize("model", sorted(robot_models()))
@pytest.mark.parametrize("sensor", sorted(range_finders()))
def test_every_catalogue_entry_makes_a_valid_scenario(file: Path, model: str, sensor: str) -> None:
    used = [
        f"robots.{k}.{field}={name}"
        for k in range(3)
        for field, name in (("model", model), ("sensor", sensor))
    ]
    scenario = load(file, used)
    assert set(scenario.models) == {model}
    assert set(scenario.sensors) == {sensor}


def test_catalogue_entries_cite_a_source() -> None:
    entries = sorted((ROOT / "maniple" / "cli" / "catalogue").rglob("*.toml"))
    assert len(entries) == len(robot_models()) + len(range_finders())
    assert all(path.read_text().startswith("# ") for path in entries)


@pytest.mark.parametrize("path", sorted((ROOT / "scenarios").glob("*.toml")), ids=lambda path: path.stem)
def test_every_scenario_that_comes_with_maniple_is_valid(path: Path) -> None:
    assert load(path).name == path.stem
