"""Start of the node: compiled kernels, what the last run has found, and memory given back."""
