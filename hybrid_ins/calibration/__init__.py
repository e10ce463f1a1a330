"""
Calibration of an IMU and a GNSS receiver from recordings, by maximum likelihood.

``recording`` reads what is needed from a bag. ``innovations`` and ``filter_pass`` run the filter
over it for given parameters; ``likelihood`` makes the log-likelihood of the innovations a function
of the parameters, and ``fit`` maximises it. ``derived`` estimates what follows from the states of
the fitted filter, ``calibrate`` turns all of it into ``findings``, verdicts and parameters, and
``report`` these into text.
"""
