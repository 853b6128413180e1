"""The commands: one thin module per verb, each with `main(argv=None) -> int`; common and files hold what they share."""

import _signal  # built in and loaded by now, where `signal` takes milliseconds
import sys

#: The rest of a program's imports takes seconds, and its end some more: a signal then kills it, without a traceback of
#: Python's. `common.run` handles signals while there is something to clear up.
_program = sys.argv[0].replace("\\", "/") if sys.argv else ""
if _program.rpartition("/")[2].startswith("pd4dgs-") or _program.endswith("pd4dgs_codec/__main__.py"):
    if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
        _signal.signal(_signal.SIGINT, _signal.SIG_DFL)
