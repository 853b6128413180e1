#!/usr/bin/env bash
# Makes its own environment in .venv-test and passes the tests, in one process more than there are cores, since some of
# them wait. Arguments go to pytest, e.g. `-m slow`, `-k rate`, or `-n 0` for one process.
set -euo pipefail
cd "$(dirname "$0")/.."
source tools/environment.sh
make_environment .venv-test train,eval,test
.venv-test/bin/ruff check pd4dgs_codec spec tests tools benchmarks
.venv-test/bin/ruff format --check --quiet pd4dgs_codec spec tests tools benchmarks
.venv-test/bin/mypy & # beside the tests
types=$!
workers=$(.venv-test/bin/python -c "import os; print(min(os.cpu_count() + 1, 4))")
code=0
.venv-test/bin/python -m pytest -n "$workers" --dist worksteal "$@" || code=$?
wait $types
exit $code
