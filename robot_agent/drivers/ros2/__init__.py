"""A robot that speaks ROS 2 as a driver."""
