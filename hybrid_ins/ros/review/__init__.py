"""Causes of trouble that lie in the input, named while the estimator runs."""
