"""The field experiment on recorded quadrotor flights."""
