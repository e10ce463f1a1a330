"""ROS messages as records and arrays: bytes, axes, units, topics."""
