"""Levels of noise estimated from recent IMU samples: of the IMU, of the non-holonomic constraint."""
