"""Logs of receivers, autopilots and IMUs, each format read by a module of its own."""
