"""Programs and their parts that work on files: no middleware, no real time."""
