"""Accuracy and consistency of estimates: figures, tables and reports."""
