"""Odometry and reports on their way out."""
