"""
The border to ROS: messages, ENU and FLU axes, degrees, topics, wording.

The files beside the folders are the node and what it alone needs. The folders import only those
further down in this list:

- ``start``: compiled kernels and what the last run has found;
- ``estimator``: messages in, reports out, for the node and for ``ins_replay``;
- ``aids``, ``review``: what helps without fixes, and causes of trouble in the input;
- ``placement``, ``output``: where the sensors are, and what is published;
- ``reporting``: verdicts, diagnostics and their words;
- ``messages``: their bytes, axes, units and topics.
"""
