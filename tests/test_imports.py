"""Who may import whom, read from the source of every room; decoding where torch cannot be imported,
and the tests that SECURITY.md names."""

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from strategies import small_file

import pd4dgs_codec

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

PACKAGE = Path(pd4dgs_codec.__file__).parent
ROOT = PACKAGE.parent

#: What every room may import.
EVERYWHERE = {"errors", "scene"}


def read_map() -> dict[str, set[str]]:
    """Room -> the other rooms that it may import, from the table in CONTRIBUTING.md."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    table = text[text.index("<!-- map:") : text.index("<!-- end of map -->")]
    rows = re.findall(r"^\| `(\w+)` \| [^|]+ \| ?([^|]*?) ?\|$", table, flags=re.MULTILINE)
    return {room: {name for name in names.split(", ") if name} for room, names in rows if not names.startswith("every")}


ALLOWED = read_map()
#: These may import every room but `cli`: what the package measures of itself, its commands, its entry points.
ABOVE_ALL = {"bench", "cli", "__init__", "__main__"}
#: Rooms that a decoder is made of, and the libraries that they may use.
DECODER = ("errors", "scene", "entropy", "tensors", "kinds", "format", "web")
LIBRARIES = {"numpy", "constriction", "msgpack", "zstandard"}


@cache
def imports() -> dict[str, set[str]]:
    """Absolute name of every module -> what it imports. Worked out where it is tested, not in all that collect it."""
    return {name: imported(path) for name, path in MODULES.items()}


def room_of(module: str) -> str:
    """The room of an absolute module name of ours."""
    return module.split(".")[1] if "." in module else "__init__"


def modules() -> dict[str, Path]:
    """Absolute name -> source file of every module of the package."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 2 else parts)] = path
    return found


def imported(path: Path) -> set[str]:
    """Absolute names that a source file imports, inside functions and TYPE_CHECKING blocks too."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.module and not node.level, f"{path}: a relative import, expected absolute ones"
            name = node.module
            names |= {f"{name}.{alias.name}" if f"{name}.{alias.name}" in MODULES else name for alias in node.names}
    return names


MODULES = modules()
ROOMS = sorted({room_of(name) for name in MODULES})


def test_every_folder_with_modules_is_a_package():
    folders = {path.parent for path in PACKAGE.rglob("*.py")}  # a folder without __init__.py is missing in the wheel
    assert [folder for folder in folders if not (folder / "__init__.py").exists()] == []


def test_every_room_has_its_rule_and_every_rule_its_room():
    assert set(ROOMS) == set(ALLOWED) | ABOVE_ALL


@pytest.mark.parametrize("room", sorted(set(ALLOWED) | {"bench"}))
def test_rooms_import_only_what_lies_below_them(room):
    allowed = set(ROOMS) - ABOVE_ALL | {room} if room in ABOVE_ALL else ALLOWED[room] | EVERYWHERE | {room}
    for name in (n for n in MODULES if room_of(n) == room):
        for target in (t for t in imports()[name] if t.split(".")[0] == "pd4dgs_codec"):
            assert room_of(target) in allowed, f"{name} imports {target}"


def test_no_two_modules_need_each_other():
    try:
        TopologicalSorter({name: imports()[name] & set(MODULES) for name in MODULES}).prepare()
    except CycleError as error:
        pytest.fail(f"a circle of imports: {' -> '.join(error.args[1])}")


def test_what_codes_tensors_knows_no_kinds():
    """Modules of `format` that know kinds make scenes, and nothing below them does."""
    kinds = {name for name in MODULES if room_of(name) == "kinds"}
    scenes = {f"pd4dgs_codec.format.{name}" for name in ("check", "decoder", "encoder", "info", "plan")}
    knowing = {name for name in MODULES if room_of(name) == "format" and imports()[name] & (kinds | scenes)}
    assert knowing == scenes and not any(imports()[name] & scenes for name in kinds)


@pytest.mark.parametrize("room", DECODER)
def test_the_decoder_uses_numpy_and_two_coders_beside_the_standard_library(room):
    for name in (n for n in MODULES if room_of(n) == room):
        for target in imports()[name]:
            top = target.split(".")[0]
            kernels = {"numba"} if name.endswith("_kernels") else set()  # loaded by encoders, if installed
            allowed = sys.stdlib_module_names | LIBRARIES | kernels | {"pd4dgs_codec"}
            assert top in allowed, f"{name} imports {target}"


def test_every_mandatory_dependency_is_imported_by_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    used = {target.split(".")[0] for names in imports().values() for target in names}
    assert set(project["dependencies"]) <= used


SCRIPT = """
import sys
for name in ("torch", "numba", "scipy", "PIL", "http.server"):
    sys.modules[name] = None
import pd4dgs_codec
assert not [m for m in sys.modules if m.startswith("pd4dgs_codec.")], "importing the package loads its modules"
scene = pd4dgs_codec.decode(sys.stdin.buffer.read())
print(scene.layers, len(scene.anchor_q), pd4dgs_codec.FORMAT_VERSION)
"""


def test_decoding_needs_no_torch():
    data = small_file()
    done = subprocess.run([sys.executable, "-c", SCRIPT], input=data, capture_output=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout.decode().split() == ["(0,", "1,", "2)", str(len(pd4dgs_codec.decode(data).anchor_q)), "5.0"]
