"""How Ctrl-C, SIGTERM and a terminal that closes end a command: without a traceback, and with nothing left behind.

Before `interruptible` and after it a program has nothing to clear up, and signals kill it (see `cli`). Within it they
raise KeyboardInterrupt in the main thread, as Ctrl-C does in any Python program.
"""

import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
AGAIN_SECONDS = 0.01  #: until a signal is raised again that came where Python only prints exceptions
UNHANDLED = (signal.SIG_DFL, signal.default_int_handler)


class _State:
    """held: blocks that signals wait for. waiting: one does. over: the command has ended by one; more are ignored."""

    held, waiting, over = 0, False, False


def _received(number: int, frame: FrameType | None) -> None:
    if _State.held:
        _State.waiting = True
    elif not _State.over:
        raise KeyboardInterrupt


def _raise_again() -> None:
    """In the main thread, whichever this one is: it may wait for the system."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:  # on Windows
        signal.raise_signal(signal.SIGINT)


@contextmanager
def held() -> Iterator[None]:
    """Lets signals wait until the block ends, if `interruptible` handles them. For moments, not for work."""
    _State.held += 1
    try:
        yield
    finally:
        _State.held -= 1
        if _State.waiting and not _State.held:
            _State.waiting = False
            _raise_again()


def ignore_more() -> None:
    """Ignores further signals until the end of `interruptible`: the command ends by the first."""
    _State.over = True


@contextmanager
def interruptible() -> Iterator[bool]:
    """Within the block ENDING raise KeyboardInterrupt, but those that are ignored or that others handle. Gives whether
    any does; in other threads than the main one, and within another such block, none does."""
    hook = sys.unraisablehook

    def lost(event: Any) -> None:
        """Python prints what a callback of its own raises, also where a signal came, and goes on."""
        if issubclass(event.exc_type, KeyboardInterrupt):
            threading.Timer(AGAIN_SECONDS, _raise_again).start()
        else:
            hook(event)

    outermost = False
    try:
        with _handled(ENDING, _received, UNHANDLED.__contains__) as outermost:
            if outermost:
                sys.unraisablehook = lost
            yield outermost
    finally:
        if outermost:
            sys.unraisablehook, _State.over, _State.waiting = hook, False, False


@contextmanager
def stop_request() -> Iterator[threading.Event]:
    """Gives what the first Ctrl-C or SIGTERM sets; every further one raises KeyboardInterrupt. Ignored signals stay
    ignored, and in other threads than the main one nothing changes."""
    stop = threading.Event()

    def received(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    with _handled((signal.SIGINT, signal.SIGTERM), received, lambda handler: handler is not signal.SIG_IGN):
        yield stop


@contextmanager
def _handled(numbers: Iterable[int], by: Callable[..., None], replaced: Callable[[Any], bool]) -> Iterator[bool]:
    """Within the block those of the signals whose handlers are to be `replaced` call `by`. Gives whether any does; none
    outside of the main thread, where Python allows no handlers."""
    main = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in numbers if main}
    before = {number: handler for number, handler in before.items() if replaced(handler)}
    try:
        for number in before:
            signal.signal(number, by)
        yield bool(before)
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
