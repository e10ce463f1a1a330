"""
The filter: numpy and numba, NED and FRD, SI units and radians.

It imports neither ROS nor plots nor the network's run time, touches no file, and does nothing at
import; tests check that.
"""
