"""What helps where fixes are missing, and what is claimed then."""
