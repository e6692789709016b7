"""What viewers draw, derived from the messages: Foxglove's own types in protobuf, and JSON for plots.

Importing this imports protobuf: only where viewer channels are made.
"""

from maniple.recording.viz.channels import Channel, Drawn, channels_of
from maniple.recording.viz.viewer import Viewer

__all__ = ["Channel", "Drawn", "Viewer", "channels_of"]
