"""
The filter itself: pure numpy and numba.

Nothing here imports ROS, files, plots or the network's run time; a test says so.
"""
