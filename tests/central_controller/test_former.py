"""Which of the last words of a former life are enough to go on."""

from typing import Any

import pytest

from central_controller.former import FormerLife
from maniple.core.messages import FormationState, Goal, Mission, Progress, Seat

NAMES = ("r1", "r2", "r3")


def mission(
    incarnation: int = 1, number: int = 4, places: tuple[int, ...] = (1, 0, 2), **changes: Any
) -> Mission:
    seats = tuple(Seat(name, place) for name, place in zip(NAMES, places, strict=False))
    return Mission(
        incarnation=incarnation,
        seq=number,
        number=number,
        stage="running",
        seats=seats,
        progress=Progress(0, 1),
    )


def state(incarnation: int = 1, number: int = 4, seq: int = 100) -> FormationState:
    return FormationState(
        incarnation=incarnation,
        seq=seq,
        phase="running",
        task_time_s=7.0,
        task_duration_s=10.0,
        reference=(1.0, 2.0, 0.0),
        reference_velocity=(0.0, 0.0, 0.0),
        chain=NAMES,
        errors=b"",
        roster=(),
        mission=number,
        progress=Progress(1, seq),
    )


def record(*messages: Mission | FormationState) -> Any:
    former = FormerLife(3, NAMES)
    for message in messages:
        former.heard(message)
    return former.record()


@pytest.mark.parametrize("order", [1, -1])
def test_both_and_of_the_same_time_are_enough(order: int) -> None:
    said = (mission(), state())[::order]
    found = record(*said)
    assert (found.mission, found.state, found.progress) == (mission(), state(), Progress(1, 100))


@pytest.mark.parametrize("later", [mission(number=5), mission(incarnation=2, number=1)])
def test_a_mission_that_was_sent_before_its_state_tells_itself_how_far_it_was(later: Mission) -> None:
    assert record(later, state()).progress == Progress(0, 1)


@pytest.mark.parametrize(
    "said",
    [
        [],
        [mission()],
        [state()],
        [mission(), state(number=5)],
        [mission(), state(incarnation=2, number=0)],
        [mission(incarnation=3), state()],
        [mission(), state(incarnation=3)],
        [mission(places=(0, 1)), state()],
        [mission(places=(0, 0, 1)), state()],
        [mission(places=(0, 1, 3)), state()],
    ],
)
def test_less_is_not(said: list[Any]) -> None:
    assert record(*said) is None


def test_the_newest_count_whatever_their_order() -> None:
    old, new = state(seq=99), state(seq=100)
    assert record(new, old, mission()).progress == Progress(1, 100)
    assert record(old, new, mission(), mission(number=3)).mission.number == 4


def test_it_says_what_is_known_and_keeps_the_goal() -> None:
    former = FormerLife(2, NAMES)
    assert former.missing == "nothing"
    former.heard(mission())
    assert former.missing == "only the task, not how far it is"
    former.heard(state())
    assert former.missing == "only that the reference was at (1.0, 2.0), 7 s into its task"
    former.heard(Goal(id="a"))
    former.heard(Goal(id="b"))
    assert former.goal is not None
    assert former.goal.id == "b"
