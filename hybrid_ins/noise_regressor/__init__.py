"""Noise levels of the IMU, estimated from its recent samples."""
