"""A part of a recording as a recording of its own."""

from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

from maniple.recording.absence import CUT_NAME, cuts_of
from maniple.recording.reader import Recording
from maniple.recording.rewrite import Rewriter, beside
from maniple.recording.selection import Selection
from maniple.recording.split import GOES_ON_NAME, is_latched
from maniple.recording.tally import GAPS_NAME
from maniple.recording.writer import METADATA_NAME, Latched, attachment_of


class Cut(msgspec.Struct, frozen=True, kw_only=True):
    """What was taken."""

    files: tuple[str, ...]
    out: str
    messages: int
    """Taken."""
    viewer_messages: int
    """Taken of what was derived for viewers."""
    latched: tuple[str, ...]
    """Topics whose last message from before the cut is attached, as it still holds."""


def cut(recording: Recording, selection: Selection, out: Path | None = None) -> Cut:
    """Write what a selection takes into a new recording, by default FILE-cut.mcap: one file, whatever parts
    the other has. What was derived for viewers is taken where no topics are chosen, or with its key chosen.

    Messages of latched topics that hold when the cut begins are attached, as a recorder does that begins in
    the middle, with the times when they were sent and recorded; so nothing is there twice.

    Raises:
        RecordingError: the recording is damaged, or the new file exists or can't be made.
    """
    target = out or beside(recording.path, "cut")
    latched = latched_before(recording, selection)
    counts = {True: 0, False: 0}
    metadata = _metadata_of(recording, selection)
    with Rewriter(target, metadata, [*recording.attachments, *map(attachment_of, latched)]) as writer:
        for layout, raw, topic in recording.raw(_taker(recording, selection), selection):
            writer.add(layout, raw, topic)
            counts[bool(topic)] += 1
    return Cut(
        files=tuple(map(str, recording.paths)),
        out=str(target),
        messages=counts[True],
        viewer_messages=counts[False],
        latched=tuple(one.topic for one in latched),
    )


def latched_before(recording: Recording, selection: Selection) -> tuple[Latched, ...]:
    """The last message of every latched topic that a selection takes, from before it begins, by topic.

    Raises:
        RecordingError: the recording is damaged.
    """
    found = {one.topic: one for one in recording.latched if selection.takes(one.topic)}
    if (start := selection.start_ns) is not None:
        for entry in recording.messages(
            lambda name: is_latched(name) and selection.takes(name), end_ns=start
        ):
            found[entry.topic] = Latched(entry.topic, entry.data, entry.log_time_ns, entry.publish_time_ns)
    return tuple(found[name] for name in sorted(found))


def _taker(recording: Recording, selection: Selection) -> Callable[[str], bool]:
    """Whether the messages of a key are taken."""

    def takes(key: str) -> bool:
        return selection.takes(recording.topic_of(key) or key.strip("/"))

    return takes


def _metadata_of(recording: Recording, selection: Selection) -> Mapping[str, Mapping[str, str]]:
    """That of all parts, the last word of each, but how it came about: that is the first part's."""
    metadata: dict[str, Mapping[str, str]] = {}
    for part in recording.all_metadata:
        metadata |= part
    metadata[METADATA_NAME] = recording.metadata
    metadata.pop(GAPS_NAME, None)
    metadata.pop(GOES_ON_NAME, None)
    cuts = [*cuts_of(metadata.get(CUT_NAME, {})), selection]
    metadata[CUT_NAME] = {"cuts": msgspec.json.encode(cuts).decode()}
    return metadata
