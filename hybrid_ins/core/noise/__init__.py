"""Noise of the IMU and of fixes: given, learned from windows, and weighed by the innovations."""
