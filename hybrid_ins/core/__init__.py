"""
The filter: numpy and numba, NED and FRD, SI units and radians.

It imports neither ROS nor plots nor the network's run time, touches no file, and does nothing at
import; tests check that. Its folders import only those further down in this list:

- ``navigator``: one vehicle over time; ``smoothing``: the same with hindsight;
- ``alignment``: from nothing to a state;
- ``filter``: samples forward, measurements at their own stamps;
- ``constraints``, ``aiding``: what vehicles cannot do, and sensors besides GNSS;
- ``sensor_errors``, ``noise``: what is estimated beside the state;
- ``fix_checks``, ``imu_axes``: what fixes and motion show to be wrong;
- ``update``: the Kalman equations; ``imu``: samples; ``inertial``: the navigation equations.
"""
