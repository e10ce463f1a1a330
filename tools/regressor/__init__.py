"""Training data and training of the noise regressors."""
