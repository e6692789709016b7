"""Whatever happened to a file: every command that reads it ends in a result or in one clear message."""

import random
import resource
import shutil
import signal
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

import maniple
from maniple.cli.log.group import app
from maniple.cli.report_command import report
from maniple.core.errors import ManipleError, RunError
from maniple.host.playing.cues import cues, latched
from maniple.recording.reader import read
from tests.cli.scenes import platoon

LONGEST_S = 60
MOST_MEMORY = 300 << 10
"""KiB more than before."""

app.command("report")(report)


def command(*arguments: str) -> Callable[[Path, Path, Path], int]:
    """A command of `maniple log` on a damaged FILE, in a folder of its own; WHOLE is the file as it was.
    Returns its exit status."""

    def run(file: Path, whole: Path, folder: Path) -> int:
        names = {
            "FILE": str(file),
            "WHOLE": str(whole),
            "OUT": str(folder / "out"),
            "NEW": str(folder / "n.mcap"),
        }
        result = CliRunner().invoke(app, [names.get(word, word) for word in arguments])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert "Traceback" not in result.output
        return result.exit_code

    return run


def played(file: Path, _whole: Path, _folder: Path) -> int:
    """What `maniple log play` does before it says anything."""
    recording = read(file)
    known = len(latched(recording.messages()))
    return int(sum(1 for _ in cues(recording.messages())) < known)


COMMANDS: dict[str, tuple[Callable[[Path, Path, Path], int], int]] = {
    "info": (command("info", "FILE"), 1),
    "info --json": (command("info", "FILE", "--json"), 7),
    "recover": (command("recover", "FILE", "--out", "NEW"), 1),
    "cut": (command("cut", "FILE", "--from", "0.2", "--until", "0.8", "--out", "NEW"), 1),
    "merge": (command("merge", "WHOLE", "FILE", "--out", "NEW"), 1),
    "merge, the reference": (command("merge", "FILE", "WHOLE", "--out", "NEW", "--take-reference"), 3),
    "verify": (command("verify", "FILE", "--jobs", "1"), 3),
    "diff": (command("diff", "WHOLE", "FILE"), 3),
    "rerun": (command("rerun", "FILE", "--set", "controller.kappa=0.4"), 5),
    "rerun --closed-loop": (command("rerun", "FILE", "--closed-loop", "--out", "NEW"), 11),
    "play": (played, 1),
    "export csv": (command("export", "FILE", "--to", "csv", "--out", "OUT"), 3),
    "export parquet": (command("export", "FILE", "--to", "parquet", "--out", "OUT"), 5),
    "export foxglove": (command("export", "FILE", "--to", "foxglove", "--out", "NEW"), 5),
    "report": (command("report", "FILE", "--out", "OUT"), 23),
}
"""What reads a recording, and how many damaged files there are for one that it is tried on."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small real recording, with channels for viewers."""
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    maniple.run(platoon(3), virtual=True, duration_s=1.2, log=path)
    return path


def damaged(content: bytes, number: int) -> tuple[str, bytes]:
    """One of many ways to be damaged: cut off, bits flipped, bytes lost, zeroed, made huge, or moved."""
    rng = random.Random(number)
    bad = bytearray(content)
    kind = ("cut off", "flipped", "flipped", "many flipped", "zeroed", "huge", "lost", "doubled")[number % 8]
    place = rng.randrange(len(bad))
    length = min(rng.choice([1, 8, 100, 5000]), len(bad) - place)
    if kind == "cut off":
        del bad[place:]
    elif kind == "flipped":
        bad[place] ^= 1 << rng.randrange(8)
    elif kind == "many flipped":
        for _ in range(rng.randrange(2, 50)):
            bad[rng.randrange(len(bad))] ^= 1 << rng.randrange(8)
    elif kind == "zeroed":
        bad[place : place + length] = bytes(length)
    elif kind == "huge":
        bad[place : place + 8] = (1 << rng.choice([31, 32, 40, 60, 63])).to_bytes(8, "little")
    elif kind == "lost":
        del bad[place : place + length]
    else:
        bad[place:place] = bad[rng.randrange(len(bad)) :][:length]
    return kind, bytes(bad)


@contextmanager
def in_time() -> Iterator[None]:
    """No longer than so, and no memory to speak of."""

    def late(*_: object) -> None:
        raise AssertionError(f"takes more than {LONGEST_S} s")

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    old = signal.signal(signal.SIGALRM, late)
    signal.alarm(LONGEST_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MOST_MEMORY


def ended(run: Callable[[], int], what: object) -> str:
    """How a command ends."""
    try:
        with in_time():
            status = run()
    except ManipleError as error:
        said, failed = str(error), isinstance(error, RunError)
    except Exception as error:
        raise AssertionError(f"{what}: {error!r}") from error
    else:
        assert status in (0, 1), (what, status)
        return "a result"
    assert said, what
    assert len(said) < 2000, (what, said)
    assert not failed, (what, said)
    return "a message"


def try_all(whole: Path, folder: Path, numbers: range, but: str = "") -> Counter[tuple[str, str]]:
    """How often each command ended how."""
    content = whole.read_bytes()
    ends: Counter[tuple[str, str]] = Counter()
    for number in numbers:
        kind, bad = damaged(content, number)
        for name, (run, each) in COMMANDS.items():
            if (number - numbers.start) % each or name == but:
                continue
            place = folder / "place"
            place.mkdir()
            (file := place / "bad.mcap").write_bytes(bad)
            end = ended(partial(run, file, whole, place), (number, kind, name))
            ends[name, end] += 1
            assert file.read_bytes() == bad
            if name == "recover" and (made := place / "n.mcap").exists():
                assert all(entry.topic for entry in read(made).messages())
            shutil.rmtree(place)
    return ends


@pytest.mark.slow
def test_whole_is_fine(whole: Path, tmp_path: Path) -> None:
    """So that what follows is about the damage."""
    for name, (run, _) in COMMANDS.items():
        folder = tmp_path / name.replace(" ", "-")
        folder.mkdir()
        shutil.copy(whole, folder / "a.mcap")
        assert run(folder / "a.mcap", whole, folder) in (0, 1), name


def test_damaged_files(whole: Path, tmp_path: Path) -> None:
    ends = try_all(whole, tmp_path, range(24), but="report")
    assert ends["recover", "a result"] > 15


@pytest.mark.slow
@pytest.mark.parametrize("begin", range(1000, 2000, 250))
def test_a_thousand_damaged_files(whole: Path, tmp_path: Path, begin: int) -> None:
    ends = try_all(whole, tmp_path, range(begin, begin + 250))
    print(sorted(ends.items()))
    for name in COMMANDS:
        tried = sum(count for (found, _), count in ends.items() if found == name)
        assert tried >= 250 // COMMANDS[name][1]
    assert ends["recover", "a result"] > 150
