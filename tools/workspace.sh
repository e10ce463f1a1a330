#!/usr/bin/env bash
# Build hybrid_ins in a colcon workspace, with the system's Python as it is (PEP 668).
#
#   src/hybrid_ins/tools/workspace.sh [WORKSPACE]        default: the current folder
#
# What apt does not have goes into WORKSPACE/.venv, an environment that sees the system's packages.
# Its Python builds the package, so that `ros2 run` starts the programs with it.
set -euo pipefail

workspace=$(cd "${1:-.}" && pwd)
venv=$workspace/.venv

die() {
    echo "tools/workspace.sh: error: $*" >&2
    exit 2
}

[ -f "$workspace/src/hybrid_ins/package.xml" ] ||
    die "$workspace is no workspace with src/hybrid_ins: clone it there, or name the workspace"
python3 -c "import rclpy" 2>/dev/null ||
    die "python3 finds no rclpy: source /opt/ros/jazzy/setup.bash first"
python3 -c "import colcon_core" 2>/dev/null ||
    die "there is no colcon: sudo apt install python3-colcon-common-extensions"

if [ ! -x "$venv/bin/pip" ]; then
    python3 -m venv --system-site-packages "$venv" ||
        die "cannot make $venv: sudo apt install python3-venv"
fi
touch "$venv/COLCON_IGNORE" # colcon searches the workspace for packages
"$venv/bin/pip" install 'numpy<2' matplotlib mcap numba onnxruntime PyYAML rosbags scipy tqdm zstandard

cd "$workspace"
"$venv/bin/python" -m colcon build --packages-select hybrid_ins
echo "built: source $workspace/install/setup.bash && ros2 run hybrid_ins ins_node"
