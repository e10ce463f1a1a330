"""Where the sensors are on the vehicle."""
