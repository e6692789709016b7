from maniple.core.messages import EmergencyStop, FaultPlan, Goal, Status, Truth
from maniple.core.scenario.types import Crash, Freeze
from maniple.core.time import SECOND
from maniple.recording.viz.narrator import Narrator


def status(mode: str, reason: str = "", life: int = 1) -> Status:
    return Status(
        source="r1",
        incarnation=life,
        mode=mode,  # type: ignore[arg-type]
        guard="none",
        command_age_s=0.0,
        command_age_max_s=0.0,
        driver="active",
        reason=reason,
        counters={},
    )


def truth(*contacts: str) -> Truth:
    return Truth(
        source="simulator",
        robots=(),
        poses=b"",
        velocities=b"",
        clearances=b"",
        collisions=0,
        contacts=contacts,
    )


def test_a_mode_is_told_when_it_begins() -> None:
    said = [
        status("waiting", "no command yet"),
        status("tracking"),
        status("tracking"),
        status("holding", "the command is 2.1 s old"),
        status("holding", "the command is 2.6 s old"),
        status("emergency", "smoke"),
        status("stopped", "told to stop"),
    ]
    narrator = Narrator()
    assert [tuple(line.happening) for one in said for line in narrator.hear(one)] == [
        ("r1 waiting: no command yet", "info"),
        ("r1 tracking", "info"),
        ("r1 holding: the command is 2.1 s old", "warning"),
        ("r1 emergency: smoke", "error"),
        ("r1 stopped: told to stop", "info"),
    ]


def test_another_life_is_told() -> None:
    narrator = Narrator()
    lives = [(2, "tracking"), (2, "tracking"), (3, "tracking"), (1, "tracking")]
    lines = [line.happening.what for life, mode in lives for line in narrator.hear(status(mode, life=life))]
    assert lines == ["r1 tracking", "r1 lives anew"]


def test_a_contact_is_told_when_it_begins() -> None:
    narrator = Narrator()
    said = [truth(), truth("r1|r2"), truth("r1|r2", "r3|obstacle 0"), truth("r1|r2"), truth(), truth("r1|r2")]
    assert [line.happening.what for one in said for line in narrator.hear(one)] == [
        "contact: r1 and r2",
        "contact: r3 and obstacle 0",
        "contact: r1 and r2",
    ]


def test_what_is_handed_over_again_is_told_once() -> None:
    narrator = Narrator()
    stop = EmergencyStop(source="operator", incarnation=7, stopped=True)
    armed = EmergencyStop(source="operator", incarnation=8, stopped=False)
    goal = Goal(source="operator", id="a", hold=True)
    said = [stop, stop, goal, goal, armed]
    assert [line.happening.what for one in said for line in narrator.hear(one)] == [
        "emergency stop",
        "goal: hold",
        "armed",
    ]


def test_faults_from_before_are_not_told() -> None:
    """In a part that was cut out of a recording."""
    crashes = tuple(Crash(node="r2", at_s=at_s) for at_s in (2.0, 8.0))
    narrator = Narrator(FaultPlan(since_ns=0, crashes=crashes))
    assert list(narrator.due(7 * SECOND)) == []
    assert [line.happening.what for line in narrator.due(8 * SECOND)] == ["r2 is killed"]


def test_faults_are_told_as_they_begin() -> None:
    crash, freeze = Crash(node="r2", at_s=2.0), Freeze(node="r3", at_s=4.0, for_s=1.0)
    narrator = Narrator(FaultPlan(since_ns=SECOND, crashes=(crash,), freezes=(freeze,)))

    def told(at_s: float) -> list[str]:
        return [line.happening.what for line in narrator.due(round(at_s * SECOND))]

    assert told(2.9) == []
    assert told(3.0) == ["r2 is killed"]
    again = FaultPlan(stamp_ns=round(3.5 * SECOND), since_ns=SECOND, crashes=(crash,))
    assert list(narrator.hear(again)) == []
    assert told(9.0) == []  # the freeze was taken back, the crash is known
    late = FaultPlan(stamp_ns=10 * SECOND, since_ns=SECOND, freezes=(freeze,))
    assert list(narrator.hear(late)) == []
    assert told(9.9) == []
    assert told(10.0) == ["r3 is frozen for 1 s"]
