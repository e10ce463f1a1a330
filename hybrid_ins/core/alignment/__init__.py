"""From nothing to a state: level, position, and a bank of filters over headings and clocks."""
