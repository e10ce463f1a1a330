"""The programs: options and one call each."""
