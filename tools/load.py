"""Load test of a server: python tools/load.py URL [--clients 1 100 1000] [--bytes N] [--seconds 20]

Each client connects, requests the first bytes of the file, as a player does, and disconnects. There are as many
requests as clients, at least 200; no row takes longer than --seconds. All clients share one process.
"""

from __future__ import annotations

import argparse
import asyncio
import time
from urllib.parse import urlsplit


async def ask(host: str, port: int, path: str, size: int) -> float:
    """Seconds until `size` bytes of the body have arrived."""
    begun = time.perf_counter()
    reader, writer = await asyncio.open_connection(host, port)
    try:
        head = f"GET {path} HTTP/1.1\r\nHost: {host}\r\nRange: bytes=0-{size - 1}\r\nConnection: close\r\n\r\n"
        writer.write(head.encode())
        status = await reader.readline()
        if b" 206 " not in status:
            raise OSError(f"found {status!r}, expected 206")
        while (await reader.readline()).strip():
            pass
        await reader.readexactly(size)
    finally:
        writer.close()
    return time.perf_counter() - begun


async def row(url: str, clients: int, size: int, limit: float) -> str:
    """A line of the table for this number of concurrent clients."""
    parts, requests = urlsplit(url), max(200, clients)
    turns, failed = asyncio.Semaphore(clients), 0
    times: list[float] = []

    async def one() -> None:
        nonlocal failed
        async with turns:
            try:
                left = limit - (time.perf_counter() - begun)
                times.append(
                    await asyncio.wait_for(ask(parts.hostname or "", parts.port or 80, parts.path, size), left)
                )
            except (OSError, asyncio.TimeoutError, asyncio.IncompleteReadError):
                failed += 1

    begun = time.perf_counter()
    await asyncio.gather(*(one() for _ in range(requests)))
    seconds = time.perf_counter() - begun
    times.sort()
    middle, late = (times[int(len(times) * share)] if times else float("nan") for share in (0.5, 0.99))
    return (
        f"| {clients} | {requests} | {failed} | {1000 * middle:.0f} | {1000 * late:.0f} | {len(times) / seconds:.0f} |"
    )


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url")
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 100, 1000])
    parser.add_argument("--bytes", type=int, default=300_000, help="of the file's beginning")
    parser.add_argument("--seconds", type=float, default=20.0, help="of a row, at most")
    args = parser.parse_args()
    print("| clients | requests | failed | median ms | 99 % ms | answers/s |\n|-|-|-|-|-|-|")
    for clients in args.clients:
        print(asyncio.run(row(args.url, clients, args.bytes, args.seconds)), flush=True)


if __name__ == "__main__":
    main()
