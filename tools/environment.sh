# Sourced by demo.sh, docs.sh, test.sh and .ci/run: makes (or reuses) a virtual environment with this package, versions
# pinned.
# usage: make_environment FOLDER EXTRAS
export PYTHONDONTWRITEBYTECODE= # where it is set, each of some hundred processes compiles its modules anew

make_environment() {
    local folder=$1 extras=$2 python=${PYTHON:-python3} stamp
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
        { echo "Python >= 3.10 is needed, found $("$python" --version)" >&2; return 1; }
    stamp=$(cat pyproject.toml constraints.txt | cksum)-$extras
    if [ "$(cat "$folder/.stamp" 2>/dev/null)" != "$stamp" ]; then
        echo "Making the environment $folder (once; the packages of training are 300 to 450 MB) ..." >&2
        "$python" -m venv "$folder"
        # half a minute of compiling is saved: of 11,000 modules most are never imported
        "$folder/bin/python" -m pip install --quiet --no-compile --constraint constraints.txt --editable ".[$extras]"
        echo "$stamp" > "$folder/.stamp"
    fi
}
