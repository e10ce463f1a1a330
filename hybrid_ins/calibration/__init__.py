"""Calibration of an IMU and a GNSS receiver from recordings."""
