#!/usr/bin/env bash
# Set up, then fly: a flight through the live node over DDS, and how well it did.
#
#   tools/demo.sh                    a simulated 60 s quadrotor flight
#   tools/demo.sh --flight FOLDER    a recorded one of the quadrotor dataset, calibrated first
#   tools/demo.sh --help             all options
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
bash "$root/tools/setup.sh" plot
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE # see tools/setup.sh
export PYTHONPATH=$root${PYTHONPATH:+:$PYTHONPATH}
exec "$root/.venv/bin/python" -m tools.demo "$@"
