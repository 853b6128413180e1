"""`pytest tests/stability --table` also prints the rows that it tested as Markdown, and their counts by group."""

from itertools import groupby

from promises import FAIL, PASS, REFUSED, Row

from pd4dgs_codec.bench.report import markdown, optional


def pytest_addoption(parser):
    parser.addoption("--table", action="store_true", help="print the stability table")


def pytest_terminal_summary(terminalreporter, config):
    if config.getoption("--table", False):
        reports = [report for outcome in ("passed", "failed") for report in terminalreporter.getreports(outcome)]
        properties = [dict(report.user_properties) for report in reports if report.when == "call"]
        terminalreporter.write_line(table([found["row"] for found in properties if "row" in found]))


def table(rows: list[Row]) -> str:
    """A table per group, and one of all groups: counts, and how close the worst case comes to its bound."""
    parts, groups = [], []
    for group, found in groupby(sorted(rows, key=lambda row: row["group"]), lambda row: row["group"]):
        own = list(found)
        cells = [
            [*(row[key].replace("|", "\\|") for key in ("case", "fed", "promised", "got"))]
            + [optional(row["error"], ".2g"), optional(row["bound"], ".2g"), row["status"]]
            for row in own
        ]
        head = ("case", "input", "promise", "result", "error", "bound", "status")
        parts.append(f"## {group}\n\n{markdown(head, cells)}")
        counts = [str(sum(row["status"] == status for row in own)) for status in (PASS, REFUSED, FAIL)]
        shares = [row["error"] / row["bound"] for row in own if row["status"] == PASS and row["bound"]]
        groups.append([group, *counts, optional(max(shares, default=None), ".3f")])
    head = ("group", "within the bound", "refused", "failed", "largest error / bound")
    return "\n\n".join([*parts, markdown(head, groups)])
