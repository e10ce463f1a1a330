"""The experiments of Or & Klein (2022), repeated and extended on simulated data."""
