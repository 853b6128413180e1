"""The latency report as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pd4dgs_codec.bench.latency.faults import RATE, STALL_SECONDS, Cuts, Row
from pd4dgs_codec.bench.latency.measure import TOLERANCE, TOLERANCE_SECONDS, Crowd, Times
from pd4dgs_codec.bench.latency.published import FIRST_FRAME
from pd4dgs_codec.bench.markdown import markdown


@dataclass(frozen=True)
class FileReport:
    """What was measured of one file. quality: mPSNR in dB per level, None without a dataset. first_start: seconds to
    the first picture where no kernel is compiled yet."""

    name: str
    bytes: int
    anchors: int
    size: tuple[int, int]
    times: list[Times]
    quality: list[float] | None
    first_start: float


def text(files: Sequence[FileReport], runs: int, faults: Sequence[Row], cuts: Cuts | None, crowd: Crowd | None) -> str:
    """All sections that were measured, as Markdown."""
    parts = [_times(file, runs) for file in files]
    if files:
        parts.append(_beside_monoliths(files))
    if faults:
        parts.append(_faults(faults))
    if cuts:
        what = f"{cuts.cuts:,} random cuts and resets in {cuts.transfers:,} transfers without a limit"
        parts.append(f"{what}: {cuts.wrong} transfers with a picture that differs; {cuts.seconds:.0f} s.")
    if crowd:
        parts.append(_crowd(crowd))
    return "\n\n".join(parts)


def _times(file: FileReport, runs: int) -> str:
    head = (
        "rate", "level", "mPSNR dB", "S, bytes", "8S/B", "network", "off", "within", "picture, warm", "after last byte",
        "picture, cold",
    )  # fmt: skip
    rows = []
    for row in file.times:
        quality = "-" if file.quality is None else f"{file.quality[_place(file, row)]:.2f}"
        off = row.network - row.expected
        rows.append(
            (
                _rate(row.rate),
                str(row.level),
                quality,
                f"{row.bytes:,}",
                f"{row.expected:.4f}",
                f"{row.network:.4f}",
                f"{1e3 * off:+.1f} ms, {off / row.expected:+.1%}",
                "yes" if row.within else "no",
                f"{row.picture:.3f}",
                f"{row.after_last_byte:.3f}",
                f"{row.cold:.2f}",
            )
        )
    width, height = file.size
    promise = f"max({TOLERANCE:.0%}, {1e3 * TOLERANCE_SECONDS:.0f} ms)"
    lines = [
        f"## {file.name}: {file.anchors:,} anchors in layer 0, {width}x{height}",
        f"Seconds since the request, medians of {runs}. Within: the network's time is off from 8S/B by at most "
        f"{promise}. Cold: since the start of a process, whose imports run while the bytes arrive.",
        markdown(head, rows),
        f"A first start after installation, which compiles the kernels: {file.first_start:.1f} s to the first picture.",
    ]
    return "\n\n".join(lines)


def _place(file: FileReport, row: Times) -> int:
    return sorted({other.level for other in file.times}).index(row.level)


def _beside_monoliths(files: Sequence[FileReport]) -> str:
    rates = sorted({row.rate for row in files[0].times})
    rows = [
        (f"{row.method}, published", f"{1e6 * row.megabytes:,.0f}", *(f"{8e6 * row.megabytes / r:,.2f}" for r in rates))
        for row in FIRST_FRAME
    ]
    for file in files:
        levels = {row.level: row.bytes for row in file.times}
        for level, size in (list(levels.items())[-1], list(levels.items())[0]):
            seconds = [row.network for row in sorted(file.times, key=lambda r: r.rate) if row.level == level]
            what = "layer 0" if level == 0 else f"layers to {level}"
            rows.append((f"{file.name}, {what}, measured", f"{size:,}", *(f"{s:,.2f}" for s in seconds)))
    head = ("what must arrive before it shows", "bytes", *(f"s at {_rate(rate)}" for rate in rates))
    said = (
        "Published are sizes, averages over seven scenes of the Dycheck iPhone captures (other scenes than ours), and "
        "their seconds are 8S/B: the network alone."
    )
    return f"## Beside monolithic models\n\n{said}\n\n{markdown(head, rows)}"


def _faults(rows: Sequence[Row]) -> str:
    head = ("the link or the server", "shown, at seconds since the request", "then", "did", "bytes sent", "right")
    cells = []
    for row in rows:
        shown = ", ".join(f"{'' if name == 'old' else name + ' '}{level} at {at:.2f}" for name, level, at in row.shown)
        did = f"{_count(row.requests, 'request')}, {_count(row.cuts, 'cut')}, {_count(row.changes, 'change')}"
        end = row.error.replace("|", "\\|") or "all is here"
        cells.append((row.name, shown or "nothing", end, did, f"{row.sent:,}", "yes" if row.kept else "NO"))
    said = (
        f"At {_rate(RATE)}; silence counts as a cut after {STALL_SECONDS:g} s here (10 by default). Shown: levels as "
        "they are decoded, those of the file that took the place of the first one called new. Right: each equals, "
        "array by array, that of an uninterrupted decode, and the transfer ended as it had to."
    )
    return f"## Faults\n\n{said}\n\n{markdown(head, cells)}"


def _crowd(crowd: Crowd) -> str:
    wrong = "no error" if not crowd.errors else f"{len(crowd.errors)} errors: {'; '.join(crowd.errors[:3])}"
    link = f"{crowd.clients} clients at once, {crowd.bytes:,} bytes each over one link of {_rate(crowd.rate)}"
    return f"{link}: {wrong}, {crowd.seconds:.2f} s (8S/B: {crowd.expected:.2f} s)."


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _rate(rate: float) -> str:
    return f"{rate / 1e6:g} Mbps"
