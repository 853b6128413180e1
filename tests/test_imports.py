"""Who may import whom, read from the source; and decoding where torch cannot be imported."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
from strategies import make_scene

import pd4dgs_codec
from pd4dgs_codec.codec.encoder import encode

ROOT = Path(pd4dgs_codec.__file__).parent

#: Part of the package -> the parts it may import; errors, scene and morton are free to all.
ALLOWED = {
    "errors": set(),
    "atomic": set(),
    "morton": set(),
    "scene": set(),
    "bitstream": set(),
    "entropy": set(),
    "attributes": set(),
    "evaluate": set(),
    "codec": {"bitstream", "entropy", "attributes", "evaluate"},
    "delivery": {"bitstream", "entropy", "attributes", "codec"},
}
#: Outside packages that these parts may use.
LIBRARIES = {"numpy", "constriction", "msgpack", "zstandard"}
WITHOUT_TORCH = ["errors", "atomic", "morton", "scene"]
WITHOUT_TORCH += ["bitstream", "entropy", "attributes", "evaluate", "codec", "delivery"]


def modules(part):
    path = ROOT / part
    return sorted(path.rglob("*.py")) if path.is_dir() else [p for p in (ROOT / f"{part}.py",) if p.exists()]


def imported(path):
    """Absolute names that a source file imports, inside functions and TYPE_CHECKING blocks too."""
    package = path.relative_to(ROOT.parent).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            name = ".".join(part for part in (base, node.module) if part)
            yield from ((f"{name}.{alias.name}" for alias in node.names) if name == "pd4dgs_codec" else (name,))


def test_the_reader_of_imports_reads_relative_ones():
    names = set(imported(ROOT / "entropy" / "ans.py"))
    assert {"pd4dgs_codec.errors", "numpy", "constriction"} <= names


@pytest.mark.parametrize("part", [p for p in ALLOWED if modules(p)])
def test_parts_import_only_what_lies_before_them(part):
    for path in modules(part):
        for name in imported(path):
            if name.startswith("pd4dgs_codec."):
                target = name.split(".")[1]
                assert target in ALLOWED[part] | {part, "errors", "scene", "morton"}, f"{path.name} imports {name}"


@pytest.mark.parametrize("part", [p for p in WITHOUT_TORCH if modules(p)])
def test_the_decoder_side_uses_numpy_constriction_msgpack_and_the_standard_library(part):
    for path in modules(part):
        for name in imported(path):
            top = name.split(".")[0]
            assert top in sys.stdlib_module_names | LIBRARIES | {"pd4dgs_codec", "__future__"}, f"{path.name}: {name}"


def test_every_mandatory_dependency_is_imported():
    (line,) = re.findall(r"^dependencies = (.*)$", (ROOT.parent / "pyproject.toml").read_text(), re.MULTILINE)
    found = {name.split(".")[0] for path in ROOT.rglob("*.py") for name in imported(path)}
    assert set(ast.literal_eval(line)) <= found


SCRIPT = """
import sys
for name in ("torch", "numba", "scipy", "PIL", "zstandard"):
    sys.modules[name] = None
import pd4dgs_codec
assert not [m for m in sys.modules if m.startswith("pd4dgs_codec.")], "importing the package loads its modules"
scene = pd4dgs_codec.decode(sys.stdin.buffer.read())
print(scene.layers, len(scene.anchor_q), pd4dgs_codec.FORMAT_VERSION)
"""


def test_decoding_needs_no_torch_and_no_zstandard():
    scene = make_scene(3, anchors=12)
    data = encode(scene, layers=2, effort=1)
    done = subprocess.run([sys.executable, "-c", SCRIPT], input=data, capture_output=True, cwd=ROOT.parent)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout.decode().split() == ["(0,", "1,", "2)", str(len(pd4dgs_codec.decode(data).anchor_q)), "1.0"]
