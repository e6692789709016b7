"""The platoon in ROS 2's own messages: what `maniple bridge ros2` publishes, and what a rosbag2 holds.

Importing this imports protobuf and rosbags: only where ROS 2 is asked for.
"""

from maniple.recording.ros2.names import Names, Said, Topic
from maniple.recording.ros2.translation import Translation

__all__ = ["Names", "Said", "Topic", "Translation"]
