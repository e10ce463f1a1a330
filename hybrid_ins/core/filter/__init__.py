"""The error-state filter: samples forward, events at their own stamps, late ones by going back."""
