#!/usr/bin/env bash
# Decodes and rebuilds every conformance vector under several Pythons and versions of numpy; all must give the same
# bits. usage: tools/determinism.sh PYTHON [NUMPY-VERSION] ...   e.g. python3.10 1.26.4 python3.12 python3.13 2.1.0
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
while [ $# -gt 0 ]; do
    python=$1 numpy=
    shift
    case ${1:-} in [0-9]*) numpy="==$1"; shift ;; esac
    "$python" -m venv --clear "$folder/env"
    "$folder/env/bin/python" -m pip install --quiet "numpy$numpy" constriction msgpack zstandard
    echo "$("$folder/env/bin/python" --version), numpy $("$folder/env/bin/python" -c 'import numpy; print(numpy.__version__)'):"
    PYTHONPATH=. "$folder/env/bin/python" tools/make_vectors.py --check
done
