"""The state at every time, given all measurements before and after it."""
