"""Stand-ins for commands: functions that workers of every engine find by name."""

import json
import os
import signal
import time
from pathlib import Path


def upper(verb: str, argv: list[str]) -> tuple[int, str, str]:
    """Writes its input in capitals, or fails or dies where the input says so. "die FLAG", "dawdle FLAG" and "fail FLAG"
    happen once: they make the flag, a file."""
    text = Path(argv[0]).read_text()
    word, _, flag = text.partition(" ")
    if flag and not Path(flag).exists():
        Path(flag).touch()
        if word == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if word == "dawdle":
            time.sleep(600)
        if word == "fail":
            return 1, "", "first line\npd4dgs-encode: error: not this time"
    if text == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if text == "bad":
        return 1, "", "a long story\npd4dgs-encode: error: never\n"
    if text == "wrong":
        return 2, "", "pd4dgs-encode: error: usage\n"
    Path(argv[argv.index("--output") + 1]).write_text(text.upper())
    with open(Path(os.environ["COUNT"]) / str(time.monotonic_ns()), "w") as note:
        note.write(text)
    return 0, json.dumps({"bytes": len(text), "table": [1]}), ""
