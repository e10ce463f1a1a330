"""Pictures of runs and calibrations, drawn with matplotlib."""
