"""The measurement update: what sensors measure, how far to believe it, the Kalman equations."""
