#!/usr/bin/env bash
# Makes its own environment in .venv-test and passes the tests. Arguments go to pytest, e.g. `-m slow` or `-k rate`.
set -euo pipefail
cd "$(dirname "$0")/.."
source tools/environment.sh
make_environment .venv-test train,eval,test
.venv-test/bin/ruff check pd4dgs_codec tests tools
.venv-test/bin/mypy
exec .venv-test/bin/python -m pytest "$@"
