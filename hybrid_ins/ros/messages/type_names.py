"""Names of the types of messages that come in and go out."""

from __future__ import annotations

IMU = "sensor_msgs/msg/Imu"
FIX = "sensor_msgs/msg/NavSatFix"
GPS_FIX = "gps_msgs/msg/GPSFix"
PRESSURE = "sensor_msgs/msg/FluidPressure"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ACCELERATION = "geometry_msgs/msg/AccelWithCovarianceStamped"
VECTOR = "geometry_msgs/msg/Vector3Stamped"
ODOMETRY = "nav_msgs/msg/Odometry"
STATUS = "diagnostic_msgs/msg/DiagnosticStatus"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
