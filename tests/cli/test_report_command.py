import json
from pathlib import Path

from tests.cli.scenes import start
from tests.report.recordings import filtered, recorded


def test_report_from_the_command_line(tmp_path: Path) -> None:
    run = recorded(tmp_path, "task.end=[0.3, 0.0]", "task.settle_s=1.0")
    log = filtered(run, tmp_path / "states.mcap", lambda m: m.topic in ("sim/truth", "formation/state"))
    with start("report", log, "--json", "--out", tmp_path / "out") as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    found = json.loads(out)
    assert found["page"] == str(tmp_path / "out" / "index.html")
    assert Path(found["page"]).exists()
    assert found["figures"]["completed"] is True
    with start("report", log, "--out", tmp_path / "out") as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 2
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert "--force" in err
