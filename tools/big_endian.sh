#!/usr/bin/env bash
# Decodes the conformance vectors by spec/refdec.py on an emulated big-endian machine (s390x) and compares with the
# manifest. Takes Debian's packages; installs nothing. usage: tools/big_endian.sh [vectors of at most so many bytes]
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
mkdir -p "$folder/state/lists/partial" "$folder/cache/archives/partial" "$folder/host" "$folder/target"

options=(-qq -o APT::Architecture=s390x -o APT::Architectures::=s390x -o "Dir::State::Lists=$folder/state/lists"
    -o "Dir::Cache=$folder/cache" -o Dir::State::Status=/dev/null -o "APT::Sandbox::User=$(id -un)")
python=$(apt-cache depends python3-minimal | grep -om1 'python3\.[0-9]*')
(cd "$folder/host" && apt-get -qq -o "APT::Sandbox::User=$(id -un)" download qemu-user-static)
apt-get "${options[@]}" update
(cd "$folder/target" && apt-get "${options[@]}" download \
    "$python-minimal" "lib$python-minimal" "lib$python-stdlib" libc6 zlib1g libexpat1 libssl3)
for side in host target; do
    for package in "$folder/$side"/*.deb; do dpkg -x "$package" "$folder/$side"; done
done
"$folder/host/usr/bin/qemu-s390x-static" -L "$folder/target" "$folder/target/usr/bin/$python" -I -S - "${1:-1000000000}" <<'PYTHON'
import importlib.util, json, platform, sys
from pathlib import Path

spec = importlib.util.spec_from_file_location("refdec", "spec/refdec.py")
refdec = importlib.util.module_from_spec(spec)
spec.loader.exec_module(refdec)
rows = json.loads(Path("spec/vectors/manifest.json").read_text(encoding="utf-8"))["vectors"]
wrong = seen = 0
for row in rows:
    if row["size"] > int(sys.argv[1]):
        continue
    seen += 1
    try:
        answer = refdec.hashes(Path("spec/vectors", row["file"]).read_bytes())
    except refdec.Fault as fault:
        answer = fault.name
    if answer != row.get("error", row["layers"]):
        wrong += 1
        print(f"{row['file']}: {answer}")
print(f"{platform.machine()}, {sys.byteorder}-endian, Python {platform.python_version()}:")
print(f"{seen - wrong} of {seen} vectors decoded as expected, {len(rows) - seen} larger ones skipped")
sys.exit(wrong > 0)
PYTHON
