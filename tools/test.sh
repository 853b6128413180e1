#!/usr/bin/env bash
# Makes its own environment in .venv-test and passes the tests, a worker per core. Arguments go to pytest, e.g. `-m slow`,
# `-k rate`, or `-n 0` for one process.
set -euo pipefail
cd "$(dirname "$0")/.."
source tools/environment.sh
make_environment .venv-test train,eval,test
.venv-test/bin/ruff check pd4dgs_codec spec tests tools
.venv-test/bin/ruff format --check --quiet pd4dgs_codec spec tests tools
.venv-test/bin/mypy
exec .venv-test/bin/python -m pytest -n auto --maxprocesses 4 --dist worksteal "$@"
