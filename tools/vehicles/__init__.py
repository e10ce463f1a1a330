"""The node's estimator on vehicles other than the field experiment's quadrotor."""
