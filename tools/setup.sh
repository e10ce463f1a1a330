#!/usr/bin/env bash
# Make .venv hold the package, ROS 2 Jazzy and the named extras of setup.py.
#
#   tools/setup.sh [EXTRA...]        for example: tools/setup.sh plot test
#
# ROS comes from a sourced ROS 2 Jazzy installation where there is one, otherwise from wheels.
# Does nothing when all of it is there already.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=$root/.venv
extras=("$@")

die() {
    echo "tools/setup.sh: error: $*" >&2
    exit 2
}

# Says why a Python cannot be used; says nothing of one that can.
objection_to() {
    "$1" - 2>/dev/null <<'EOP' || echo "does not start"
import os, sys
version = "%d.%d" % sys.version_info[:2]
try:
    import ensurepip, venv
    if os.environ.get("ROS_DISTRO"):
        import rclpy
except ImportError as error:
    if getattr(error, "name", "").startswith(("ensurepip", "venv")):
        objection = "has no venv module: sudo apt install python%s-venv" % version
    else:
        objection = "finds no rclpy: source /opt/ros/jazzy/setup.bash or unset ROS_DISTRO"
else:
    objection = ""
if not (3, 10) <= sys.version_info[:2] <= (3, 14):
    objection = "is Python " + version
print(objection)
EOP
}

find_python() {
    local candidate objection first=
    for candidate in python3 python3.13 python3.12 python3.11 python3.10 python3.14; do
        command -v "$candidate" >/dev/null || continue
        objection=$(objection_to "$candidate")
        if [ -z "$objection" ]; then
            python=$candidate
            return
        fi
        first=${first:-$candidate $objection}
    done
    die "needs Python 3.10 to 3.14 with its venv module; ${first:-there is no python3 here}"
}

# A virtual environment cannot be moved, nor change its Python or where its ROS comes from.
identity() { echo "$root $("$venv/bin/python" --version 2>&1) ${ROS_DISTRO:-wheels}"; }

contents() {
    identity
    cat "$root/setup.py" "$root/package.xml" "${BASH_SOURCE[0]}"
}

make_environment() {
    find_python
    mkdir -p "$venv" 2>/dev/null && [ -w "$venv" ] && [ -w "$root" ] ||
        die "cannot write to $root: copy the project to a folder of yours"
    local options=(--clear)
    [ -z "${ROS_DISTRO:-}" ] || options+=(--system-site-packages)
    "$python" -m venv "${options[@]}" "$venv" || die "$python cannot make $venv"
}

install() {
    local log=$venv/setup.log reason wanted
    [ -n "${ROS_DISTRO:-}" ] || extras+=(ros)
    wanted=$(IFS=, && echo "${extras[*]}")
    echo "Setting up .venv with $("$venv/bin/python" --version), $wanted: the first time takes" \
        "about a minute" >&2
    "$venv/bin/python" -m pip install --disable-pip-version-check \
        --editable "$root${wanted:+[$wanted]}" >"$log" 2>&1 && return
    if grep -q -i -E 'connection|name resolution|unreachable|timed out|proxy' "$log"; then
        reason='the package index cannot be reached; is there a network?'
    else
        reason=$(grep -m 1 -i error "$log" || tail -n 1 "$log")
    fi
    die "installing failed: $reason (all of it in $log)"
}

case ${ROS_DISTRO:-} in
    '' | jazzy) ;;
    *) die "ROS '$ROS_DISTRO' is sourced and this is for ROS 2 Jazzy: use a shell where no ROS" \
        "is sourced, and Jazzy comes from wheels" ;;
esac

# Inherited from another environment, it keeps Python from finding the ROS libraries of this one.
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE

if command -v flock >/dev/null; then # one at a time
    exec 9<"$root"
    flock 9
fi

stamp=$venv/ready-$(IFS=- && echo "${extras[*]}")
[ "$(contents | cksum)" != "$(cat "$stamp" 2>/dev/null)" ] || exit 0
[ "$(identity)" = "$(cat "$venv/identity" 2>/dev/null)" ] || make_environment
rm -f "$venv/identity" # so that an interrupted installation starts afresh
install
if ! "$venv/bin/python" -m hybrid_ins.kernels >&2 2>>"$venv/setup.log"; then
    echo "tools/setup.sh: the filter could not be compiled ahead (see $venv/setup.log); the first" \
        "start will try again" >&2
fi
identity >"$venv/identity"
contents | cksum >"$stamp"
