"""Programs for work on the package itself; run each as ``python -m tools.FOLDER.NAME``."""
