#!/usr/bin/env bash
# Set up, lint, check the types and run the tests. Arguments go to pytest:
#
#   tools/test.sh                  everything
#   tools/test.sh -k alignment     the tests about alignment
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash tools/setup.sh plot test
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE # see tools/setup.sh
export PATH=$PWD/.venv/bin:$PATH

status=0
ruff check --quiet || status=1
if python -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
    mypy --no-error-summary || status=1
else
    echo "tools/test.sh: types are not checked: those of the numpy for Python 3.10 are too old" >&2
fi
[ $status = 0 ] || echo "tools/test.sh: the checks above failed; now the tests" >&2
python -m pytest "$@" || status=$?
exit $status
