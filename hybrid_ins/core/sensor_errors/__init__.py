"""Errors of clock, antenna and IMU scale, estimated beside the 15 states."""
