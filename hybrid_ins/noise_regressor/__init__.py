"""Noise levels from recent IMU samples: of the IMU, and of the non-holonomic constraint."""
