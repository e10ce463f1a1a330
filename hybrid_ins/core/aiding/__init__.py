"""Sensors that aid the filter besides GNSS, and how long each is believed."""
