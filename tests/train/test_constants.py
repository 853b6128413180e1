"""docs/constants.md against the numbers in train/ and model/: a new number needs a row with its reason."""

import ast
import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "pd4dgs_codec"
#: Numbers of functions that need no row: indices, halves, squares, numbers of axes.
SMALL = {-1, 0, 0.5, 1, 2, 3, 4}
BOUNDS = ("least", "most", "above", "count")  #: of an option: what a user may ask for
MOST = 110  #: of the numbers that decide behaviour
KINDS = {"behaviour", "size", "safety", "cost", "unit"}
REASONS = {"measured", "published", "unit", "not measured"}


def numbers(node: ast.AST) -> list[float]:
    """The values of the numbers in an expression; arithmetic on literals is one number, an option's bounds are none."""
    try:
        if not isinstance(node, ast.Tuple) and not any(isinstance(n, ast.Call | ast.Name) for n in ast.walk(node)):
            value = eval(compile(ast.Expression(node), "", "eval"))  # type: ignore[arg-type]
            if type(value) in (int, float):
                return [value]
    except (TypeError, ValueError, SyntaxError):
        pass
    parts = ast.iter_child_nodes(node)
    kept = [n for n in parts if not (isinstance(n, ast.keyword) and n.arg in BOUNDS)]
    return [value for part in kept for value in numbers(part)]


def assigned(body: list[ast.stmt], prefix: str) -> dict[str, list[float]]:
    """Numbers by name: of assignments, and of functions those that are not SMALL."""
    found: dict[str, list[float]] = {}
    for s in body:
        if isinstance(s, ast.ClassDef):
            found |= assigned(s.body, f"{prefix}.{s.name}")
        elif isinstance(s, ast.FunctionDef):
            inner = [v for part in (*s.body, *s.args.defaults) for v in numbers(part) if v not in SMALL]
            if inner:
                found[f"{prefix}.{s.name}()"] = inner
        elif isinstance(s, ast.Assign | ast.AnnAssign) and s.value is not None:
            (target,) = s.targets if isinstance(s, ast.Assign) else (s.target,)
            if isinstance(target, ast.Tuple) and isinstance(s.value, ast.Tuple):
                pairs = zip(target.elts, s.value.elts, strict=True)
            else:
                pairs = iter([(target, s.value)])
            found |= {f"{prefix}.{ast.unparse(t)}": own for t, value in pairs if (own := numbers(value))}
    return found


def in_source() -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for path in sorted([*(PACKAGE / "train").rglob("*.py"), *(PACKAGE / "model").rglob("*.py")]):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        found |= assigned(ast.parse(path.read_text()).body, name)
    return found


def in_table() -> dict[str, tuple[list[str], str, str]]:
    """(values, kind, reason) by name."""
    text = (ROOT / "docs" / "constants.md").read_text()
    rows = re.findall(r"^\| `(.+?)` \| (.+?) \| (.+?) \| (.+?) \|$", text, re.M)
    assert len(rows) == len({name for name, *_ in rows})
    return {name: (values.split(", "), kind, reason) for name, values, kind, reason in rows}


def test_every_number_has_a_row_with_its_value_and_reason():
    table = in_table()
    assert {name: values for name, (values, *_) in table.items()} == {
        name: [f"{value:.4g}" for value in values] for name, values in in_source().items()
    }
    for name, (_, kind, reason) in table.items():
        assert kind in KINDS and reason, name
        assert kind != "behaviour" or reason.split(":")[0] in REASONS, name


def test_few_numbers_decide_behaviour():
    counts = Counter(kind for values, kind, _ in in_table().values() for _ in values)
    assert counts["behaviour"] <= MOST
    head = (ROOT / "docs" / "constants.md").read_text().split("\n|")[0]
    assert {int(n) for n in re.findall(r"\b\d+\b", head)} == {*counts.values(), counts.total(), MOST}


def test_a_number_without_a_row_is_found():
    source = "A, B = 0.25, (3, -1 / 4)\nC = call(7, least=9)\ndef f(x=5):\n    return x * 0.5 + 8\n"
    found = assigned(ast.parse(source).body, "m")
    assert found == {"m.A": [0.25], "m.B": [3, -0.25], "m.C": [7], "m.f()": [8, 5]}
