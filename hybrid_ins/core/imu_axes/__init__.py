"""Axes, units and mount of an IMU, checked against the motion that fixes show."""
