"""What happens to a process that is told to stop, whose parent is gone, or that would do what another one does."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType

from filelock import FileLock, Timeout

TERMINATION = (signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
"""Signals that tell a process to stop; Windows has no SIGHUP, which comes when a terminal or a connection is gone."""


def exit_when_terminated() -> None:
    """Leave by an exception when told to stop, as Python does on Ctrl-C; what is ignored (`nohup`) stays ignored."""
    for number in TERMINATION:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_: sys.exit("terminated; the same command with --resume=true goes on"))


@contextmanager
def deferred_signals() -> Iterator[list[int]]:
    """Let Ctrl-C and what tells to stop wait for the end of a block, which gets the list of those that have arrived.

    In another thread than the main one, which no signal interrupts, the list stays empty.
    """
    numbers = (signal.SIGINT, *TERMINATION) if threading.current_thread() is threading.main_thread() else ()
    handlers = {number: handler for number in numbers if (handler := signal.getsignal(number)) != signal.SIG_IGN}
    arrived: list[int] = []
    for number in handlers:
        signal.signal(number, lambda number, _: arrived.append(number))
    try:
        yield arrived
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in arrived:
            signal.raise_signal(number)


@contextmanager
def one_process(lock_file: Path, work: str) -> Iterator[None]:
    """Do what only one process may do at a time; the lock is free again when that process is gone, however it ended.

    Args:
        lock_file: is there meanwhile.
        work: what is done, for the error.

    Raises:
        BlockingIOError: another process does it.
    """
    lock = FileLock(lock_file)
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        raise BlockingIOError(f"another process {work}: wait for its end") from error
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes it at its release
            lock_file.unlink()
        lock.release()


def when_parent_ends(action: Callable[[], None], library: ModuleType = multiprocessing) -> None:
    """Do something as soon as the process that asked for this one is gone, even if it was killed.

    A child of a fork server would outlive it.

    Args:
        action: what to do.
        library: `multiprocessing`, or what was used in its place to start this process.
    """

    def wait() -> None:
        parent = library.parent_process()
        assert parent is not None
        parent.join()
        action()

    threading.Thread(target=wait, daemon=True).start()


def end_with_parent(library: ModuleType = multiprocessing) -> None:
    """Get SIGTERM when the parent is gone; leave Ctrl-C to it, as a terminal sends that to both."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    when_parent_ends(lambda: os.kill(os.getpid(), signal.SIGTERM), library)
