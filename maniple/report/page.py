"""The page of a report: one HTML file with everything in it, that needs no network and no script."""

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple

from maniple.recording.info import Info
from maniple.report.series import Series, outcome
from maniple.report.summary import Errors

EVENTS_SHOWN = 60
LINKS_SHOWN = 400

STYLE = """
:root { color-scheme: light dark;
  --ink: #1b1b1b; --paper: #fff; --soft: #5c5c5c; --line: #d4d4d4; --warn: #9a3b00; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e6e6; --paper: #16181b; --soft: #a8a8a8; --line: #3a3d42; --warn: #ffb37a; }
}
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 66rem;
  margin: 0 auto; padding: 1.5rem 1rem 4rem; }
h1 { font-size: 1.7rem; margin: 0 0 .2rem; } h2 { font-size: 1.2rem; margin: 2rem 0 .5rem; }
p { margin: .4rem 0; max-width: 46rem; } .soft { color: var(--soft); } .warn { color: var(--warn); }
.outcome { font-size: 1.1rem; }
table { border-collapse: collapse; font-size: .92rem; margin: .5rem 0; }
th, td { text-align: left; padding: .22rem .9rem .22rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
th { font-weight: 600; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
.scroll { overflow-x: auto; }
.figures { columns: 2 28rem; column-gap: 1.5rem; }
figure { margin: 0 0 1.5rem; break-inside: avoid; }
figure img { width: 100%; height: auto; background: #fff; border: 1px solid var(--line); border-radius: 4px;
  padding: 6px; }
figcaption { font-size: .9rem; } figcaption b { display: block; }
summary { cursor: pointer; }
@media print {
  :root { --ink: #000; --paper: #fff; --soft: #444; --line: #bbb; --warn: #7a2e00; }
  body { max-width: none; padding: 0; font-size: 10pt; } .figures { columns: 2; }
}
"""


class Picture(NamedTuple):
    """A figure on the page."""

    title: str
    caption: str
    files: tuple[Path, Path]
    """PNG and SVG; the page holds the SVG itself."""


def page(
    series: Series,
    info: Info,
    source: str,
    pictures: Sequence[Picture],
    missing: Iterable[str],
    warnings: Iterable[str],
) -> str:
    """The whole HTML document; `source` is the name of the recording, `missing` is said of figures that are
    not there, `warnings` before anything else."""
    scenario = series.scenario
    title = f"{scenario.name}: report"
    n = len(scenario.robots)
    chained = f"{n} robots, {n - 2} triangle{'s' * (n > 3)}" if n > 2 else f"{n} robots"
    parts = [
        f"<h1>{escape(scenario.name)}</h1>",
        f"<p>{escape(scenario.description)}</p>" if scenario.description else "",
        f'<p class="soft">{chained}. {escape(source)}: {escape(info.mode or "unknown")} run, '
        f"seed {escape(info.seed)}, maniple {escape(info.version)}.</p>",
        f'<p class="outcome"><b>{escape(outcome(series))}</b></p>',
        *(f'<p class="warn">{escape(line)}</p>' for line in warnings),
        "<h2>Figures of merit</h2>",
        _merit(series),
        f"<p>{escape(explained(series))}</p>",
        "<h2>Figures</h2>",
        '<div class="figures">',
        *map(_picture, pictures),
        "</div>",
        *(f'<p class="soft">{escape(line)}</p>' for line in missing),
        _events(series),
        _links(series),
    ]
    body = "\n".join(part for part in parts if part)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def notes(series: Series, info: Info) -> list[str]:
    """What a reader must know before believing the figures: gaps, damage, robots that were lost."""
    found = []
    if not info.complete:
        found.append(
            "The recording was not finished: its recorder was killed, or the file is cut. What is whole in "
            "it is shown."
        )
    if info.missing:
        worst = sorted(info.channels, key=lambda channel: -channel.missing)[:3]
        most = ", ".join(f"{channel.topic} ({channel.missing})" for channel in worst if channel.missing)
        expected = info.messages + info.missing
        found.append(
            f"{info.missing} of {expected} messages are missing in the recording by their sequence numbers, "
            f"most of {most}. Lines are broken where a source was silent for long."
        )
    if series.unreadable:
        which = ", ".join(f"{topic} ({count})" for topic, count in list(series.unreadable.items())[:5])
        found.append(f"Messages that this version can't read were left out: {which}.")
    if not series.true:
        found.append(
            "There is no ground truth: poses are what the robots believe, and true errors, clearances and "
            "collisions are not known."
        )
    elif without := series.figures.without_truth:
        found.append(
            f"There is no ground truth of {', '.join(without)}: poses are what the robots believe, and true "
            "errors, clearances and collisions are those of the others."
        )
    if lost := series.figures.lost_robots:
        found.append(f"Given up as lost at some time: {', '.join(lost)}.")
    return found


def explained(series: Series) -> str:
    """How much of the true error is dead reckoning's."""
    figures = series.figures
    true, seen = figures.final_error.position_m, figures.estimated_final_error.position_m
    if true is None:
        return "There is no true error: no ground truth while the task ran."
    text = f"The true position error at the end is {true:.3f} m"
    if seen is not None:
        text += f"; the controller sees {seen:.3f} m of it"
    if figures.odometry_drift_m is not None:
        text += f"; dead reckoning explains up to {figures.odometry_drift_m:.3f} m"
    return f"{text}."


def _merit(series: Series) -> str:
    """The figures of the run as tables."""
    figures = series.figures
    head = "<tr><th></th>" + "".join(
        f'<th class="n">{name}</th>' for name in ("position", "&psi;<sub>F</sub>", "p, q", "&beta;")
    )
    rows = [
        _errors("error at the end, true", figures.final_error),
        _errors("error at the end, as the controller sees it", figures.estimated_final_error),
        _errors("largest error, true", figures.peak_error),
    ]
    counts, age = figures.messages, figures.command_age_ms
    facts = {
        "duration": f"{figures.duration_s:.1f} s",
        "smallest clearance": _number(figures.min_clearance_m, "m"),
        "collisions": "not known" if figures.collisions is None else str(figures.collisions),
        "odometry drift at the end": _number(figures.odometry_drift_m, "m"),
        "command age": f"{age.p50:.0f} ms median, {age.p99:.0f} ms at the 99th percentile"
        if age.p50 is not None and age.p99 is not None
        else "not known",
        "messages": f"{counts.sent} sent, {counts.delivered} delivered; {counts.lost_injected} lost by "
        f"injection, {counts.lost_other} otherwise, {counts.refused} refused"
        if counts.sent
        else "not known",
    }
    told = "".join(_row(name, text) for name, text in facts.items())
    return (
        f'<div class="scroll"><table>{head}</tr>{"".join(rows)}</table></div>'
        '<p class="soft">The largest over the triangles; at the end: mean of the last second; errors count '
        "from when the formation is first built.</p>"
        f'<div class="scroll"><table>{told}</table></div>'
    )


def _errors(name: str, errors: Errors) -> str:
    cells = (
        (errors.position_m, "m"),
        (errors.orientation_rad, "rad"),
        (errors.distance_m, "m"),
        (errors.angle_rad, "rad"),
    )
    numbers = "".join(f'<td class="n">{_number(value, unit)}</td>' for value, unit in cells)
    return f"<tr><th>{name}</th>{numbers}</tr>"


def _number(value: float | None, unit: str) -> str:
    return "not known" if value is None else f"{value:.3f} {unit}"


def _row(*cells: str) -> str:
    first, *others = map(escape, cells)
    return f"<tr><th>{first}</th>{''.join(f'<td>{cell}</td>' for cell in others)}</tr>"


def _picture(picture: Picture) -> str:
    png, svg = picture.files
    data = b64encode(svg.read_bytes()).decode()
    return (
        f'<figure><img alt="{escape(picture.title)}: {escape(picture.caption)}" '
        f'src="data:image/svg+xml;base64,{data}">'
        f"<figcaption><b>{escape(picture.title)}</b>{escape(picture.caption)} "
        f'<span class="soft">Beside this page: <a href="{png.name}">PNG</a>, <a href="{svg.name}">SVG</a>.'
        "</span></figcaption></figure>"
    )


def _events(series: Series) -> str:
    """What happened, as a table."""
    if not series.events:
        return ""
    shown = series.events[:EVENTS_SHOWN]
    rows = "".join(f'<tr><td class="n">{e.t:.1f} s</td><td>{escape(e.what)}</td></tr>' for e in shown)
    more = len(series.events) - len(shown)
    rest = f'<p class="soft">and {more} more.</p>' if more else ""
    return f'<h2>What happened</h2><div class="scroll"><table>{rows}</table></div>{rest}'


def _links(series: Series) -> str:
    """Every link, as a table that is folded up."""
    if not series.links:
        return ""
    names = (
        "from",
        "to",
        "topic",
        "sent",
        "delivered",
        "lost, injected",
        "lost, other",
        "refused",
        "injected by",
    )
    head = "".join(f'<th class="{"n" * (k > 2)}">{name}</th>' for k, name in enumerate(names))
    rows = "".join(
        "<tr>"
        + "".join(f'<td class="{"n" * (k > 2)}">{escape(str(v))}</td>' for k, v in enumerate(link[:-1]))
        + f"<td>{', '.join(f'{cause} {count}' for cause, count in link.causes)}</td>"
        + "</tr>"
        for link in series.links[:LINKS_SHOWN]
    )
    more = len(series.links) - LINKS_SHOWN
    rest = f'<p class="soft">and {more} more links.</p>' if more > 0 else ""
    return (
        f"<details><summary>{len(series.links)} links that faults apply to</summary>"
        f'<div class="scroll"><table><tr>{head}</tr>{rows}</table></div>{rest}</details>'
    )
