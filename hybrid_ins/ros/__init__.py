"""The border to ROS: messages, ENU and FLU axes, degrees, topics, wording."""
