"""Programs for work on the package itself; run each as ``python -m tools.FOLDER.NAME``."""

import os

# The matrices are small, and each process has a processor to itself. Read when numpy is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from hybrid_ins import kernel_cache

kernel_cache.enable()  # a tool may call any kernel, in any of its processes
