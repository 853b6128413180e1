"""The commands: one thin module per verb, each with `main(argv=None) -> int`; common and files hold what they share."""

import os
import signal
import sys

#: The rest of a program's imports takes seconds, and its end some more: a signal then kills it, without a traceback of
#: Python's. `common.run` handles signals while there is something to clear up.
_folder, _name = os.path.split(sys.argv[0] if sys.argv else "")
if _name.startswith("pd4dgs-") or (os.path.basename(_folder), _name) == ("pd4dgs_codec", "__main__.py"):
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
