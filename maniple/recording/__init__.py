"""MCAP recordings: written, read, described."""

from maniple.recording.reader import Recorded, Recording, read

__all__ = ["Recorded", "Recording", "read"]
