"""Benchmarks: `run` measures, the other modules are its parts."""
