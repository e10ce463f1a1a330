"""Noise levels of the IMU, read off its recent samples."""
