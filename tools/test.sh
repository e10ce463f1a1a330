#!/usr/bin/env bash
# Set up, then check the format, lint and types, and run the tests on all processors.
#
#   tools/test.sh                  in a few minutes what a change of the package can break
#   tools/test.sh all              also the slow tests, the research results and the training
#   tools/test.sh -k alignment     some of the tests: options go to pytest
#   tools/test.sh -n 0 --pdb       in one process, as a debugger needs it
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
extras=(plot logs fleet lint test)
patience=()
folders=(test/unit test/scenario test/system)
chosen=(-m "not slow")
if [ "${1:-}" = all ]; then
    shift
    extras+=(train)
    folders+=(test/research)
    chosen=()
    patience=(-o timeout=900)
fi
bash tools/setup.sh "${extras[@]}"
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE # see tools/setup.sh
export PATH=$PWD/.venv/bin:$PATH
# Hundreds of processes import the package: what they compile is kept, also where a container image
# says otherwise.
export PYTHONDONTWRITEBYTECODE=

status=0
ruff format --check --quiet || {
    echo "tools/test.sh: run ruff format" >&2
    status=1
}
ruff check --quiet || status=1
if python -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
    mypy --no-error-summary || status=1
else
    echo "tools/test.sh: types are not checked: those of the numpy for Python 3.10 are too old" >&2
fi
[ $status = 0 ] || echo "tools/test.sh: the checks above failed; now the tests" >&2

named=()
for word in "$@"; do
    [ ! -e "${word%%::*}" ] || named+=("$word")
done
[ ${#named[@]} = 0 ] || folders=() chosen=()
python -m hybrid_ins.kernels >/dev/null # once, not in every process
# One process more than processors: some tests wait for other processes.
python -m pytest -n "$(($(nproc) + 1))" --dist worksteal "${chosen[@]}" "${patience[@]}" "${folders[@]}" "$@" || status=$?
exit $status
