"""Simulated motion and sensors."""
