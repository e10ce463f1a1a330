"""Fault injection and long runs."""
