#!/usr/bin/env bash
# Line and branch coverage of the packages that touch bytes, by their tests; fails under the share in pyproject.toml.
# Arguments go to pytest. PYTHON names the interpreter of an environment with the test extra (default: .venv-test's).
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv-test/bin/python}
"$python" -m coverage run -m pytest -q tests/entropy tests/format tests/spec tests/test_*.py "$@"
exec "$python" -m coverage report
