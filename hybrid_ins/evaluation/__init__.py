"""Estimates compared with truth."""
