"""
Frames, symbols and units of this package.

Frames
------
n
    Navigation frame: north, east, down (NED) at the vehicle.
b
    Body frame of the IMU after its mount rotation: forward, right, down (FRD).
e, i
    Earth-centred Earth-fixed (WGS-84) and inertial frame.
map, odom, base_link
    REP-105 frames; ENU and FLU axes. They exist in ``ros`` only.

Names
-----
``C_nb``
    Rotation matrix, body to navigation: ``v_n = C_nb @ v_b``.
``quat_xyzw``
    Unit quaternion of the same rotation, scalar last.
``lla``
    Latitude [rad], longitude [rad], height above the WGS-84 ellipsoid [m].
``velocity_n``
    Velocity over ground, NED axes [m/s].
``specific_force_b``, ``angular_rate_b``
    Readings of an IMU: [m/s²], and [rad/s] relative to the inertial frame.
``t_ns``
    Time as integer nanoseconds of the IMU clock. ``dt`` is a difference in float seconds.

Error state (15), true minus estimated
--------------------------------------
``dp`` position [m, NED], ``dv`` velocity [m/s, NED], ``eps`` misalignment [rad, n frame] with
``C_nb(true) = (I - [eps x]) C_nb(estimated)``, ``b_a`` accelerometer bias [m/s²], ``b_g`` gyroscope
bias [rad/s], both in b. The slices are defined once, in ``core.inertial.state``.

Noise
-----
``q``
    Variance of the white noise of one IMU sample, [(m/s²)²] or [(rad/s)²].
``psd``
    Power spectral density of that noise, ``q * dt``. Qc consists of these; the paper's text uses q.

Multiple models
---------------
A bank holds hypotheses (of heading, clock offset, or noise), each with a prior probability. The
log-likelihood of each innovation changes their log-weights; the mixture is the weighted mean of the
hypotheses, with their spread in its covariance.
"""
