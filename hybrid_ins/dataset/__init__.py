"""Datasets in CSV files."""
