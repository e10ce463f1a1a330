"""Strapdown navigation on the WGS-84 Earth, and the propagation of its errors."""
