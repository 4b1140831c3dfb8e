"""What happens to a process that is told to stop, or whose parent is gone."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


def exit_when_terminated() -> None:
    """Leave by an exception on SIGTERM, so that what is finished is kept."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("hdp-record: terminated; go on with --resume=true"))


@contextmanager
def deferred_signals() -> Iterator[None]:
    """Let SIGTERM and Ctrl-C wait for the end of a block. Only the main thread is ever interrupted."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: list[int] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in handlers:
        signal.signal(number, lambda number, _: arrived.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in arrived:
            signal.raise_signal(number)


def when_parent_ends(action: Callable[[], None]) -> None:
    """Do something as soon as the process that asked for this one is gone, even if it was killed.

    A child of a fork server would outlive it.
    """

    def wait() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        action()

    threading.Thread(target=wait, daemon=True).start()


def end_with_parent() -> None:
    """Leave as on SIGTERM when the parent is gone."""
    exit_when_terminated()
    when_parent_ends(lambda: os.kill(os.getpid(), signal.SIGTERM))
