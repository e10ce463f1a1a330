"""What is said of a run: verdicts, diagnostics, warnings, and their words."""
