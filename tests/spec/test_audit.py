"""spec/audit.md names what there is: vectors and registered numbers."""

import json
import re
from fnmatch import fnmatch
from pathlib import Path

import pytest

SPEC = Path(__file__).resolve().parents[2] / "spec"
AUDIT = (SPEC / "audit.md").read_text(encoding="utf-8")
FORMAT = (SPEC / "format.md").read_text(encoding="utf-8")


def section(title: str, text: str = AUDIT) -> str:
    """What stands under a heading of any level, up to the next of that level or above."""
    found = re.search(rf"^(#+) {re.escape(title)}\n(.*?)(?=^#{{1,3}} |\Z)", text, re.MULTILINE | re.DOTALL)
    assert found is not None
    return found[2]


def rows(title: str) -> list[list[str]]:
    """The cells of each row of the table under a heading, without head and rule."""
    lines = [line for line in section(title).split("\n") if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


TABLES = [
    "Preamble and chunks",
    "Header",
    "Layer parameters",
    "Channels",
    "Coded channels",
    "Kinds",
    "Extension points",
]


@pytest.mark.parametrize("title", TABLES)
def test_each_field_has_vectors(title):
    manifest = json.loads((SPEC / "vectors" / "manifest.json").read_text(encoding="utf-8"))
    names = [Path(entry["file"]).stem for entry in manifest["vectors"]]
    for row in rows(title):
        patterns = [p for cell in row for p in re.findall(r"`([\w*-]*[-*][\w*-]*)`", cell)]
        assert patterns or "reserved" in row[-1], row
        for pattern in patterns:
            assert any(fnmatch(name, pattern) for name in names), f"no vector {pattern} of {row[0]}"


def numbers(text: str) -> set[int]:
    """`1, 2, 4..16` as numbers."""
    parts = re.findall(r"(\d+)(?:\.\.(\d+))?", text)
    return {n for low, high in parts for n in range(int(low), int(high or low) + 1)}


def registry(name: str) -> str:
    """What the registry of this name holds."""
    (values,) = re.findall(rf"^\| {name} \| (.*) \|$", section("17.1 Registries", FORMAT), re.MULTILINE)
    return values


def test_each_registered_key_prior_predictor_and_kind_has_a_row():
    header, layer = re.fullmatch(r"([\d.]*) .*layer keys ([\d.]*) .*", registry("header keys")).groups()
    assert {int(row[0]) for row in rows("Header")} == numbers(header)
    assert {int(row[0]) for row in rows("Layer parameters")} == numbers(layer)
    coded = "\n".join(row[0] for row in rows("Coded channels"))
    for form in ("rows", "planes"):
        found = set(map(int, re.findall(rf"predictor of {form} (\d)", coded)))
        assert found == numbers(registry(f"predictors of {form}").split()[0])
    # the page is older than what is added after the freeze: a prior or a kind without a row is allowed
    assert set(map(int, re.findall(r"prior family (\d)", coded))) <= numbers(registry("prior families").split()[0])
    kinds = {
        f"{role} {kind}" for role in ("scene", "deformation") for kind in registry(f"kinds of {role}s").split(", ")
    }
    assert {re.sub(",", "", row[0]) + f" ({row[1]})" for row in rows("Kinds")} <= kinds


def test_each_item_of_the_channels_has_a_row():
    items = re.findall(r"^(\d)\. ", section("6.4 Channels", FORMAT), re.MULTILINE)
    assert [row[0] for row in rows("Channels")] == items and len(items) == 8


def test_each_clause_that_a_row_names_is_there():
    for title in TABLES[:-1]:
        for row in rows(title):
            for clause in re.findall(r"\d+(?:\.\d+)?", row[2] if title in TABLES[1:4] else row[1]):
                assert re.search(rf"^#+ {re.escape(clause)} ", FORMAT, re.MULTILINE), (row[0], clause)


def test_decisions_that_rows_name_are_explained():
    named = set(re.findall(r"\bF\d+\b", "".join(section(title) for title in TABLES)))
    assert named and named <= set(re.findall(r"\*\*(F\d+)\.", section("Decisions")))
