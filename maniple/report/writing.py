"""A report from a recording alone: a page and its figures, in a folder."""

from pathlib import Path

import msgspec

from maniple.core.errors import ArgumentError, ManipleError, MissingExtraError
from maniple.recording.info import describe
from maniple.recording.reader import read
from maniple.report.page import Picture, notes, page
from maniple.report.series import outcome, series_of
from maniple.report.summary import RunFigures

PAGE = "index.html"


class Report(msgspec.Struct, frozen=True):
    """What was written, and what it says."""

    recording: str
    """Its first part."""
    parts: list[str]
    """All of them."""
    page: str
    """Path of the HTML page."""
    pictures: list[str]
    """Paths of the figures, PNG and SVG."""
    scenario: str
    outcome: str
    """How the run ended, in a sentence."""
    notes: list[str]
    """What the recording lacks."""
    figures: RunFigures


def write(recording: Path, folder: Path | None = None, force: bool = False) -> Report:
    """Write the report of a recording into `folder`, by default one beside it named after it.

    With `force` files of an earlier report in it are replaced.

    Raises:
        RecordingError: it can't be opened, is not a recording made by maniple, or is damaged.
        ArgumentError: the folder holds something already.
        MissingExtraError: matplotlib is not installed.
        ManipleError: the report can't be written.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise MissingExtraError("report", "report") from None
    from maniple.report import figures

    opened = read(recording)
    out = folder or recording.with_name(f"{recording.stem}-report")
    _require_free(out, force)
    info = describe(opened)
    series = series_of(opened)
    warnings = [*notes(series, info), *opened.passed_over, *filter(None, [opened.lacking])]
    pictures, missing = [], []
    try:
        out.mkdir(parents=True, exist_ok=True)
        for kind, figure in figures.draw(series):
            if figure is None:
                missing.append(f"{kind.title}: {kind.missing}")
                for suffix in (".png", ".svg"):
                    (out / f"{kind.name}{suffix}").unlink(missing_ok=True)
            else:
                pictures.append(Picture(kind.title, kind.caption, figures.write(figure, out / kind.name)))
        target = out / PAGE
        source = ", ".join(path.name for path in opened.paths)
        target.write_text(page(series, info, source, pictures, missing, warnings), encoding="utf-8")
    except OSError as error:
        raise ManipleError(f"{out}: can't write the report: {error.strerror or error}") from None
    return Report(
        recording=str(recording),
        parts=[str(path) for path in opened.paths],
        page=str(target),
        pictures=[str(path) for picture in pictures for path in picture.files],
        scenario=series.scenario.name,
        outcome=outcome(series),
        notes=[*warnings, *missing],
        figures=series.figures,
    )


def _require_free(folder: Path, force: bool) -> None:
    """Refuse a folder that holds something, or is none."""
    try:
        if folder.exists() and not folder.is_dir():
            raise ArgumentError(f"{folder} is not a folder; --out must name one, or nothing that exists")
        held = folder.exists() and next(folder.iterdir(), None) is not None
    except OSError as error:
        raise ArgumentError(f"{folder}: {error.strerror or error}") from None
    if held and not force:
        raise ArgumentError(f"{folder} is not empty; another --out, or --force to replace an earlier report")
