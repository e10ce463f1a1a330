"""How fast the package is, and its peers beside it."""
