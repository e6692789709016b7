"""Keep, pause and resume: what a running recorder is told to do, whatever it is told over."""

from collections.abc import Callable

import msgspec

from maniple.core.errors import RecordingError
from maniple.core.time import Time, from_seconds, to_seconds
from maniple.host.recorder_orders import Answer, Order, State
from maniple.host.recorder_space import Space
from maniple.recording.absence import KEPT_NAME, PAUSES_NAME, Pause
from maniple.recording.rolling import Kept, RollingWriter
from maniple.recording.split import PartsWriter


class Control:
    """Does what one recorder is asked; `now` tells log time."""

    def __init__(
        self,
        name: str,
        writer: PartsWriter | RollingWriter,
        now: Callable[[], Time],
        space: Space | None = None,
    ) -> None:
        self._name = name
        self._writer = writer
        self._now = now
        self._space = space
        self._keep_until: Time | None = None
        self._reasons: list[str] = []
        self._pauses: list[Pause] = []

    @property
    def paused(self) -> bool:
        """Whether nothing is to be recorded now."""
        return bool(self._pauses) and self._pauses[-1].until_ns is None

    def left_out(self) -> None:
        """A message arrived in a pause."""
        self._pauses[-1].messages += 1

    def obey(self, order: Order) -> Answer:
        """Do as asked.

        Raises:
            RecordingError: the recording can't go on.
        """
        if order.what == "keep":
            return self._keep(order)
        if order.what == "pause":
            return self._pause(order.reason)
        if order.what == "resume":
            return self._resume()
        return self.answer(True, "")

    def look(self) -> None:
        """End what is kept when its time is over.

        Raises:
            RecordingError: its file can't grow.
        """
        if self._keep_until is not None and self._now() >= self._keep_until:
            self._end_keeping()

    def end(self, keep: bool) -> str:
        """The recorder ends: what there is to say of it. A ring is written out if it is to `keep` that.

        Raises:
            RecordingError: a file can't grow.
        """
        if self.paused:
            self._resume()
        writer = self._writer
        if isinstance(writer, RollingWriter) and not writer.writing:
            if keep:
                kept = writer.keep(self._now())
                writer.note_here(KEPT_NAME, {"reason": "the recorder ended"})
                return f"kept {_span(kept)}"
            if count := writer.waiting:
                return (
                    f"the last {count} messages were not kept: maniple log keep does that, or --keep-on-exit"
                )
        return ""

    def answer(self, ok: bool, text: str, kept: Kept | None = None) -> Answer:
        """What the recorder says, with how it is."""
        writer = self._writer
        state: State = "recording"
        if self.paused:
            state = "paused"
        elif isinstance(writer, RollingWriter):
            state = "keeping" if writer.writing else "rolling"
        newest = str(writer.paths[-1]) if writer.paths else ""
        found = Answer(
            recorder=self._name,
            ok=ok,
            state=state,
            text=text,
            file=newest,
            reason=self._pauses[-1].reason if self.paused else "",
        )
        if kept is None:
            return found
        path, messages, first, last = kept
        return msgspec.structs.replace(found, file=str(path), messages=messages, first_ns=first, last_ns=last)

    def _keep(self, order: Order) -> Answer:
        writer = self._writer
        if not isinstance(writer, RollingWriter):
            text = "it records everything as it comes; --keep-last makes a recorder wait for this"
            return msgspec.structs.replace(self.answer(False, text), meant=False)
        now = self._now()
        try:
            if self._space is not None:
                self._space.require()
            kept = writer.keep(now)
            if order.reason:
                self._reasons.append(order.reason)
            writer.note_here(KEPT_NAME, {"reason": "; ".join(self._reasons)})
            if order.after_s > 0.0 or self._keep_until is not None:
                self._keep_until = max(self._keep_until or now, now + from_seconds(order.after_s))
                left = to_seconds(self._keep_until - now)
                return self.answer(True, f"kept {_span(kept)}; goes on for {left:.1f} s", kept)
            self._end_keeping()
        except RecordingError as error:
            self._keep_until = None
            self._reasons.clear()
            return self.answer(False, str(error))
        return self.answer(True, f"kept {_span(kept)}", kept)

    def _end_keeping(self) -> None:
        assert isinstance(self._writer, RollingWriter)
        self._keep_until = None
        self._reasons.clear()
        self._writer.end()

    def _pause(self, reason: str) -> Answer:
        if self.paused:
            return self.answer(False, "it is paused already")
        self._pauses.append(Pause(self._now(), reason))
        self._note()
        self._writer.flush()
        return self.answer(True, "paused: what is said from now on is not recorded")

    def _resume(self) -> Answer:
        if not self.paused:
            return self.answer(False, "it is not paused")
        pause = self._pauses[-1]
        pause.until_ns = self._now()
        self._note()
        lasted = to_seconds(pause.until_ns - pause.from_ns)
        return self.answer(True, f"goes on; {pause.messages} messages in {lasted:.1f} s were left out")

    def _note(self) -> None:
        self._writer.note(PAUSES_NAME, {"pauses": msgspec.json.encode(self._pauses).decode()})


def _span(kept: Kept) -> str:
    span = to_seconds(kept.last_ns - kept.first_ns)
    return f"{kept.messages} messages of {span:.1f} s in {kept.path}"
