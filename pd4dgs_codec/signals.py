"""Lets Ctrl-C, SIGTERM and SIGHUP (a closed terminal) end a command without a traceback or leftovers.

Outside `interruptible` a program has nothing to clean up, and a signal kills it (see `cli`). Within it a signal raises
KeyboardInterrupt in the main thread, as Ctrl-C does in any Python program.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
HANGUP = getattr(signal, "SIGHUP", None)  #: None on Windows
AGAIN_SECONDS = 0.01  #: delay before a signal is raised again whose exception Python only printed
UNHANDLED = (signal.SIG_DFL, signal.default_int_handler)


class _State:
    """held: open `held` blocks. waiting: a signal came in one. over: the command is ending; ignore signals."""

    held, waiting, over = 0, False, False


def _received(number: int, frame: FrameType | None) -> None:
    if _State.held:
        _State.waiting = True
    elif not _State.over:
        raise KeyboardInterrupt


def _raise_again() -> None:
    """Sends SIGINT to the main thread from any thread, so that it wakes from a blocking system call."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:  # on Windows
        signal.raise_signal(signal.SIGINT)


@contextmanager
def held() -> Iterator[None]:
    """Delays the signals that `interruptible` handles until the block ends. For short blocks only."""
    _State.held += 1
    try:
        yield
    finally:
        _State.held -= 1
        if _State.waiting and not _State.held:
            _State.waiting = False
            _raise_again()


def ignore_more() -> None:
    """Ignores further signals until `interruptible` ends, because the first one already ends the command."""
    _State.over = True


@contextmanager
def interruptible() -> Iterator[bool]:
    """Within the block the signals ENDING raise KeyboardInterrupt unless they are ignored or have other handlers.
    Yields whether any of them does; none does outside the main thread or in a nested block."""
    hook = sys.unraisablehook

    def lost(event: Any) -> None:
        """Raises an interrupt again that came during a callback, whose exceptions Python only prints."""
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
    """Yields an event that the first signal in ENDING sets; every further one raises KeyboardInterrupt, except SIGHUP:
    the shell and the kernel both send it when a terminal closes. Ignored signals stay ignored, and outside the main
    thread nothing changes."""
    stop = threading.Event()

    def received(number: int, frame: FrameType | None) -> None:
        if stop.is_set() and number != HANGUP:
            raise KeyboardInterrupt
        stop.set()

    with _handled(ENDING, received, lambda handler: handler is not signal.SIG_IGN):
        yield stop


def follow_parent(clean: Callable[[], None]) -> None:
    """Makes this process, which `multiprocessing` started, ignore Ctrl-C, which its parent handles, and end with its
    parent, also if that is killed, after a call of `clean`."""
    import multiprocessing  # only by commands that start processes

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        clean()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@contextmanager
def _handled(numbers: Iterable[int], by: Callable[..., None], replaced: Callable[[Any], bool]) -> Iterator[bool]:
    """Within the block, signals whose current handler satisfies `replaced` call `by`. Yields whether any of them does;
    none does outside the main thread, where Python allows no handlers."""
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
