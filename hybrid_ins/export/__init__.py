"""Trajectories in the formats of other tools: TUM, CSV, KML, GPX and GeoJSON."""
