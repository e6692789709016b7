"""Commands are repeated until they are answered."""

from typing import Any

from robot_agent.drivers.mavlink.commands import AGAIN, TIMES, Answer, Commands
from tests.robot_agent.drivers.mavlink.bench import MAV

MODE, INTERVAL = 176, 511


def ack(command: int, result: int = 0) -> Any:
    return MAV.MAVLink_command_ack_message(command, result)


def commands() -> Commands:
    return Commands(MAV, (1, 1))


def test_asked_once_repeated_and_answered() -> None:
    asked = commands()
    assert asked.ask("mode", MODE, 1, 15) is None
    (first,) = asked.due(0)
    assert (first.command, first.param1, first.param2, first.confirmation) == (MODE, 1, 15, 0)
    assert asked.due(AGAIN - 1) == []
    assert asked.ask("mode", MODE, 1, 15) is None
    (second,) = asked.due(AGAIN)
    assert second.confirmation == 1
    asked.answered(ack(MODE), AGAIN)
    assert asked.ask("mode", MODE, 1, 15) == Answer(True, "ACCEPTED", AGAIN)
    assert asked.due(10 * AGAIN) == []


def test_no_answer_is_an_answer_after_a_while() -> None:
    asked = commands()
    asked.ask("mode", MODE, 1, 15)
    sent = [asked.due(turn * AGAIN) for turn in range(TIMES + 2)]
    assert [len(messages) for messages in sent] == [1] * TIMES + [0, 0]
    answer = asked.ask("mode", MODE, 1, 15)
    assert answer is not None
    assert not answer.accepted
    assert answer.words == f"no answer, asked {TIMES} times"


def test_one_of_each_command_at_a_time_in_order() -> None:
    asked = commands()
    for number in (30, 32):
        asked.ask(number, INTERVAL, number, 50_000)
    asked.ask("mode", MODE, 1, 15)
    assert sorted(message.command for message in asked.due(0)) == [MODE, INTERVAL]
    asked.answered(ack(INTERVAL, 2), 1)
    (next_one,) = asked.due(1)
    assert next_one.param1 == 32
    asked.answered(ack(INTERVAL), 2)
    assert asked.ask(30, INTERVAL) == Answer(False, "DENIED", 1)
    assert asked.ask(32, INTERVAL) == Answer(True, "ACCEPTED", 2)


def test_work_in_progress_is_waited_for() -> None:
    asked = commands()
    asked.ask("mode", MODE, 1, 15)
    asked.due(0)
    asked.answered(ack(MODE, 5), AGAIN // 2)
    assert asked.due(AGAIN) == []
    assert asked.ask("mode", MODE, 1, 15) is None


def test_what_is_forgotten_is_asked_anew() -> None:
    asked = commands()
    asked.ask("mode", MODE, 1, 15)
    asked.due(0)
    asked.forget("mode", MODE)
    asked.answered(ack(MODE), 1)  # too late: nobody waits for it
    assert asked.ask("mode", MODE, 1, 15) is None
    assert len(asked.due(2)) == 1
    asked.answered(ack(MODE, 77), 3)
    assert asked.ask("mode", MODE, 1, 15) == Answer(False, "result 77", 3)


def test_answers_to_nothing_are_nothing() -> None:
    asked = commands()
    asked.answered(ack(MODE), 0)
    assert asked.ask("mode", MODE, 1, 15) is None
