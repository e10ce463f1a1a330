"""Programs for work on the package itself; run each as ``python -m tools.FOLDER.NAME``."""

from hybrid_ins import kernel_cache

kernel_cache.enable()  # a tool may call any kernel, in any of its processes
