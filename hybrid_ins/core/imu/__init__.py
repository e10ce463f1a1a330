"""IMU samples, and what they show without any fix: faults, a stand, a lift."""
