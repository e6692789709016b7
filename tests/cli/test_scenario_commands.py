import json
import re
import sys
from pathlib import Path
from typing import Any

import matplotlib.image
import msgspec
import numpy as np
import pytest
from matplotlib.patches import Polygon
from msgspec.structs import replace
from typer.testing import CliRunner, Result

from maniple.cli import scenario_docs
from maniple.cli.draw import draw, save
from maniple.cli.loading import load, loads
from maniple.cli.scenario_commands import app
from maniple.core.errors import ManipleError, MissingExtraError, ScenarioError
from maniple.core.geometry import Pose
from maniple.core.scenario.parse import toml_data
from maniple.core.scenario.places import legs_of
from maniple.core.scenario.types import Guard, Line, Scenario
from maniple.core.scenario.ways import way_of

ROOT = Path(__file__).parents[2]
PAPER = ROOT / "scenarios" / "paper-simulation-1.toml"


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def checked(*arguments: str) -> Any:
    result = run("check", PAPER, "--json", *arguments)
    assert result.exit_code == 0
    return json.loads(result.stdout)


def test_check_says_what_would_run() -> None:
    plan = checked("--seed", "4")
    scenario = load(PAPER)
    assert plan["valid"] is True
    assert plan["seed"] == 4
    assert [robot["id"] for robot in plan["robots"]] == [robot.id for robot in scenario.robots]
    assert plan["robots"][0]["pose"] == pytest.approx(scenario.robots[0].pose)
    assert [tuple(one["robots"]) for one in plan["triangles"]] == [
        ("r1", "r2", "r3"),
        ("r2", "r3", "r4"),
        ("r3", "r4", "r5"),
        ("r4", "r5", "r6"),
    ]
    task = scenario.task
    assert isinstance(task, Line)
    way = np.hypot(*np.subtract(task.end, task.start))
    assert plan["length_m"] == pytest.approx(way)
    assert plan["duration_s"] == pytest.approx(way / task.speed_mps + task.settle_s)
    assert [leg["kind"] for leg in plan["legs"]] == [plan["task"]] == ["line"]
    for robot in plan["robots"]:
        assert 0 < robot["hold_after_s"] <= robot["stop_after_s"]
    assert plan["links"] == []


def test_check_says_what_the_network_does_to_each_link() -> None:
    plan = checked("--set", "faults=[{loss=0.5, latency_s=0.1}, {source='r1', loss=0.2, jitter_s=0.01}]")
    links = {(one["source"], one["topic"]): one for one in plan["links"]}
    assert links["r2", "robot/r2/odometry"]["loss"] == 0.5
    assert links["r1", "robot/r1/odometry"]["loss"] == pytest.approx(0.6)
    assert links["r1", "robot/r1/odometry"]["jitter_s"] == 0.01
    assert links["controller", "robot/r1/command"] == {
        "source": "controller",
        "destination": "r1",
        "topic": "robot/r1/command",
        "latency_s": 0.1,
        "jitter_s": 0.0,
        "loss": 0.5,
        "also": [],
    }
    assert ("r1", "robot/r1/ranges") in links, "the avoidance runs in the centre"
    onboard = checked("--set", "faults=[{}]", "--set", "placement.robot_from=kinematics")
    assert not any(one["topic"].endswith("ranges") for one in onboard["links"])
    hosted = checked("--set", "faults=[{}]", "--set", "controller.host=r1")
    assert {one["source"] for one in hosted["links"]} == {"controller", "r2", "r3", "r4", "r5", "r6"}
    assert not any("r1" in one["topic"] for one in hosted["links"]), "one computer has no network in itself"


def test_check_says_what_else_is_wrong_and_when() -> None:
    plan = checked(
        "--set",
        "faults=[{preset='lte', loss=0.1}, {loss=1.0, source='r2', windows=[[3, 5], [8, 9]]}]",
        "--set",
        "partitions=[{groups=[['r1', 'r2']], at_s=3, for_s=2}]",
        "--set",
        "freezes=[{node='r3', at_s=3, for_s=2}]",
        "--set",
        "clocks=[{node='r3', offset_s=-3, skew_ppm=50}]",
    )
    links = {one["topic"]: one for one in plan["links"]}
    assert links["robot/r2/odometry"]["loss"] == pytest.approx(0.1), "windows are no steady state"
    assert links["robot/r2/odometry"]["also"] == [
        "bursts (enter 0.05 %, leave 10 %; 100 % lost, else 0 %), 6000 kbit/s, queue of 1 s",
        "from 3 to 5 s, 8 to 9 s: 100 % lost",
    ]
    assert plan["notes"][-3:] == [
        "r3 is frozen from 3 s for 2 s",
        "from 3 s for 2 s apart: r1,r2 | all others",
        "the clock of r3 is -3 s off and +50 ppm fast",
    ]


def test_check_for_people() -> None:
    result = run("check", PAPER, "--set", "faults=[{loss=0.3, latency_s=0.1, jitter_s=0.05}]")
    assert result.exit_code == 0
    assert "6 robots, 4 triangles, 5 obstacles" in result.stdout
    assert re.search(r"r2 r3 r4 +\d\.\d+ +\d\.\d+", result.stdout)
    assert re.search(r"odometry from +r1 r2 r3 r4 r5 r6 +100 +50 +30\.0", result.stdout)
    assert "…" not in result.stdout


KINDS = {
    "circle": "2 x round a circle of radius 5 m, not turning, 62.83 m in 314.2 s, at up to 0.2 m/s\n",
    "figure-eight": "1 x through a figure eight of loops of 5 m, 30.49 m in 152.4 s, at up to 0.2 m/s, ",
    "waypoints": "way through 3 points, 9.142 m in 91.42 s, at up to 0.1 m/s, places at",
    "samples": "way through 3 samples, 4 m in 40 s, at up to 0.1 m/s\n",
    "positioning": "positioning at 9, 0, 0, in about 9",
    "sequence": "2 in sequence, 4 m in about 6",
}
SAMPLES = "{kind='samples', times_s=[0,20,40], poses=[[0,0,0],[2,0,0],[4,0,0]]}"
TASKS = {
    "circle": "{kind='circle', centre=[0,5], radius_m=5, speed_mps=0.2, turns=2, facing='fixed'}",
    "figure-eight": "{kind='figure-eight', centre=[0,0], size_m=5, speed_mps=0.2}",
    "waypoints": "{kind='waypoints', points=[[0,0],[5,0],[5,5]], speed_mps=0.1, radius_m=2}",
    "samples": SAMPLES,
    "positioning": "{kind='positioning', target=[9,0,0]}",
    "sequence": f"{{kind='sequence', tasks=[{{kind='positioning', target=[2,0,0]}}, {SAMPLES}]}}",
}


@pytest.mark.parametrize("kind", TASKS)
def test_every_kind_of_task_is_checked_and_drawn(kind: str) -> None:
    override = f"task={TASKS[kind]}"
    result = run("check", PAPER, "--set", override, "--set", "world.obstacles=[]")
    assert result.exit_code == 0, result.exception
    assert f"task: {KINDS[kind]}" in result.stdout
    plan = checked("--set", override, "--set", "world.obstacles=[]")
    assert plan["task"] == kind
    assert plan["duration_s"] == pytest.approx(sum(leg["duration_s"] for leg in plan["legs"]))
    scenario = load(PAPER, [override, "world.obstacles=[]"])
    (axes,) = draw(scenario).axes
    left, right = axes.get_xlim()
    low, high = axes.get_ylim()
    for leg in legs_of(scenario.task):
        way = way_of(leg)
        for t in np.linspace(0.0, way.travel_s, 50):
            for place in scenario.formation.points:
                x, y, _ = way.at(float(t))[0].compose(Pose(*place, 0.0))
                assert left < x < right
                assert low < y < high


def test_check_lists_the_parts_of_a_sequence() -> None:
    result = run("check", PAPER, "--set", f"task={TASKS['sequence']}")
    assert re.search(
        r"0 +positioning at 2, 0, 0 +0\.00, 0\.00, 0\.00 +2\.00, 0\.00, 0\.00 +about \d", result.stdout
    )
    assert re.search(r"1 +way through 3 samples .* 4\.00 +0\.100 +40\.0", result.stdout)


def test_check_says_what_is_not_as_by_default() -> None:
    changes = (
        "planning={method='optimal', build='straight', relabel=true}",
        "waiting.enabled=true",
        "controller.host=r2",
        "crashes=[{node='r4', at_s=30, restart_after_s=20}, {node='r5', at_s=40}]",
    )
    assert checked()["notes"] == []
    far = TASKS["sequence"].replace("target=[2,0,0]", "target=[0,2,0]")
    assert checked("--set", f"task={far}")["notes"] == ["task 1 starts 2 m from where task 0 ends"]
    assert checked(*(word for change in changes for word in ("--set", change)))["notes"] == [
        "who takes which place: optimal",
        "places are numbered anew",
        "the formation is built first: straight, at up to 0.1 m/s",
        "the reference slows from 0.1 m of error on, and stands at 0.5 m",
        "the controller runs on r2, in its odometry frame",
        "r4 dies at 30 s, and is back 20 s later",
        "r5 dies at 40 s",
    ]


def test_check_says_what_hardware_there_is() -> None:
    changes = (
        "robots.r1.driver=ros2",
        "robots.r1.ros2.namespace=/left",
        "robots.r2.driver=mavlink",
        "robots.r2.presents=mavlink",
        "robots.r2.scans=ros2",
        "robots.r2.ros2={router='tcp/10.0.0.2:7447', domain_id=3}",
        "guard.fence=[[-99,-99],[99,-99],[0,99]]",
    )
    plan = checked(*(word for change in changes for word in ("--set", change)))
    assert plan["notes"] == [
        "r1 is driven by ros2 (rmw_zenoh on the router of the hardware network, domain 0, namespace /left)",
        "r2 is driven by mavlink (tcp:127.0.0.1:5770, system 1, in its own frame, armed by a pilot); "
        "the simulator presents it",
        "the scans of r2 come from ros2 (rmw_zenoh on tcp/10.0.0.2:7447, domain 3, namespace r2)",
        "nothing moves before every robot has passed the pre-flight check, with a test of the emergency stop",
    ]
    assert plan["laws"][-1] == "the guard keeps inside a fence of 3 corners"


def test_check_refuses_what_is_not_valid() -> None:
    result = run("check", PAPER, "--set", "robots.1.id=r1")
    assert isinstance(result.exception, ScenarioError)
    assert "robots[1].id = 'r1'" in str(result.exception)


# -- pictures


@pytest.mark.parametrize(("suffix", "start"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_draw_writes_the_format_of_the_suffix(tmp_path: Path, suffix: str, start: bytes) -> None:
    first, second = tmp_path / f"a.{suffix}", tmp_path / f"b.{suffix}"
    for path in (first, second):
        result = run("draw", PAPER, "--out", path)
        assert result.exit_code == 0
        assert str(path) in result.stdout
    assert first.read_bytes().startswith(start)
    assert first.read_bytes() == second.read_bytes(), "the same scenario makes the same file"


def test_draw_names_its_picture_after_the_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = run("draw", PAPER, "--json")
    assert json.loads(result.stdout) == {
        "scenario": "paper-simulation-1",
        "picture": "paper-simulation-1.png",
    }
    pixels = matplotlib.image.imread(tmp_path / "paper-simulation-1.png")
    assert pixels.shape[1] > 1000
    assert pixels[..., :3].std() > 0.05, "something is drawn"


def test_draw_refuses_other_formats_and_places(tmp_path: Path) -> None:
    scenario = load(PAPER)
    with pytest.raises(ManipleError, match=r"must end in one of \.png, \.svg, \.pdf"):
        save(scenario, tmp_path / "a.gif")
    with pytest.raises(ManipleError, match="can't be written: No such file or directory"):
        save(scenario, tmp_path / "no" / "a.png")


def odd() -> Scenario:
    """Many robots with long names, turned, scattered, among obstacles of every kind."""
    points = [[-(k // 2) * 1.4 - (k % 2) * 0.7, (-1.0) ** k] for k in range(12)]
    lines = [
        'name = "odd"',
        'task = { kind = "line", start = [0, 0], end = [4, 7], speed_mps = 0.1 }',
        "start = { scatter_m = 0.3, scatter_rad = 0.6 }",
        f"formation.points = {points}",
        "robots = [" + ", ".join(f'{{ id = "robot-{k}" }}' for k in range(12)) + "]",
        "[[world.obstacles]]\nkind = 'wall'\nstart = [-3, 8]\nend = [6, 10]",
        "[[world.obstacles]]\nkind = 'box'\ncentre = [4, 1]\nsize = [2, 1]\nangle_rad = 0.5",
        "[[world.obstacles]]\nkind = 'polygon'\npoints = [[-4, 3], [-2, 3], [-2, 5], [-3, 4], [-4, 5]]",
        "[[world.obstacles]]\nkind = 'circle'\ncentre = [-3, 1.5]\nradius_m = 0.3",
    ]
    return loads("\n".join(lines).encode())


def fenced() -> Scenario:
    """With a fence far round it."""
    return replace(load(PAPER), name="fenced", guard=Guard(fence=((-9, -3), (30, -3), (25, 9), (-9, 4))))


SCENARIOS = sorted((ROOT / "scenarios").glob("*.toml"))


@pytest.mark.parametrize(
    "scenario", [odd(), fenced(), *map(load, SCENARIOS)], ids=lambda scenario: scenario.name
)
def test_everything_is_inside_the_frame_at_true_scale(scenario: Scenario) -> None:
    figure = draw(scenario)
    figure.draw_without_rendering()
    (axes,) = figure.axes
    assert axes.get_aspect() == 1.0
    frame = axes.get_window_extent()
    for thing in (*axes.patches, *axes.lines, *axes.texts):
        box = thing.get_window_extent()
        assert frame.x0 - 1 <= box.x0, thing
        assert box.x1 <= frame.x1 + 1, thing
        assert frame.y0 - 1 <= box.y0, thing
        assert box.y1 <= frame.y1 + 1, thing
    names = [text.get_text() for text in axes.texts]
    assert {robot.id for robot in scenario.robots} <= set(names)
    for text in (axes.xaxis.label, axes.yaxis.label, axes.title, *figure.legends):
        box = text.get_window_extent()
        assert figure.bbox.x0 <= box.x0
        assert box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0
        assert box.y1 <= figure.bbox.y1


# -- documents


def test_the_page_is_what_the_types_say() -> None:
    page = (ROOT / "docs" / "scenario.md").read_text(encoding="utf-8")
    assert page == scenario_docs.markdown(), "run: maniple scenario docs > docs/scenario.md"
    assert run("docs").stdout == page


def test_the_examples_of_the_page_are_valid() -> None:
    minimal, task = re.findall(r"```toml\n(.*?)```", scenario_docs.markdown(), flags=re.DOTALL)
    assert len(loads(minimal.encode()).robots) == 3
    data = toml_data(minimal.encode()) | toml_data(task.encode())
    text = msgspec.json.encode(data)
    assert loads(text, form="json", folder=ROOT / "scenarios").task != loads(minimal.encode()).task


def test_the_overrides_of_the_page_work() -> None:
    shown = re.findall(r"--set ('[^']+'|\S+)", scenario_docs.markdown())
    overrides = [text.strip("'") for text in shown if "KEY" not in text and "=" in text]
    assert len(overrides) >= 4
    load(PAPER, overrides)


def test_every_field_is_documented() -> None:
    page = scenario_docs.markdown()
    for name, said in scenario_docs.field_texts().items():
        for field, text in said.items():
            assert f"`{field}`" in page, f"{name}.{field}"
            assert text.replace("|", "\\|") in page


def test_the_schema_accepts_what_is_valid_and_describes_every_field() -> None:
    document = json.loads(run("schema").stdout)
    assert document["$schema"].endswith("2020-12/schema")
    for name, definition in document["$defs"].items():
        assert definition["additionalProperties"] is False
        for field, entry in definition["properties"].items():
            assert field == "kind" or entry["description"], f"{name}.{field}"
    assert document["$defs"]["Robot"]["properties"]["control_point_m"]["exclusiveMinimum"] == 0


def test_help_is_there() -> None:
    for command in ("check", "draw", "schema"):
        assert run(command, "--help").exit_code == 0


def test_without_matplotlib_draw_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'maniple\[report\]'"):
        save(load(PAPER), tmp_path / "a.png")


def test_a_fence_is_drawn_and_told_of() -> None:
    scenario = fenced()
    figure = draw(scenario)
    (axes,) = figure.axes
    assert (
        sum(
            isinstance(patch, Polygon)
            and patch.get_xy()[:-1].tolist() == [list(p) for p in scenario.guard.fence]
            for patch in axes.patches
        )
        == 1
    )
    assert "fence" in [text.get_text() for text in figure.legends[0].get_texts()]
    assert "fence" not in [text.get_text() for text in draw(load(PAPER)).legends[0].get_texts()]
