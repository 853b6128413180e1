"""The commands: one thin module per verb, each with `main(argv=None) -> int`, over common and options."""

import _signal  # built in and already loaded, while importing `signal` takes milliseconds
import sys

#: While a program imports its modules, which takes seconds, and while it exits, a signal kills it without a Python
#: traceback. `common.run` handles signals while there is something to clean up.
_program = sys.argv[0].replace("\\", "/") if sys.argv else ""
if _program.rpartition("/")[2].startswith("pd4dgs-") or _program.endswith("pd4dgs_codec/__main__.py"):
    if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
        _signal.signal(_signal.SIGINT, _signal.SIG_DFL)
