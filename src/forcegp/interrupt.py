"""The end of the program after an interrupt (SIGINT): exit code 130 in every phase, without a traceback."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from types import FrameType

INTERRUPTED = 130
"""Exit code after an interrupt, as in a shell."""
GRACE = 0.6
"""Time allowed for an orderly exit after an interrupt [s]."""

_interrupted = threading.Event()


def end_when_interrupted() -> None:
    """Let an interrupt end the program, after at most `GRACE` seconds.

    Python handles signals only between its own operations, not during long operations of other libraries. It
    also loses exceptions raised in destructors. The file descriptor receives the signal immediately.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return  # ignored, as in a background job, or handled by the caller or an earlier call
    wake, signals = os.pipe()
    os.set_blocking(signals, False)
    signal.set_wakeup_fd(signals, warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, _interrupt)
    # Python removes its handlers at shutdown, and an interrupt would then replace the exit code.
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.read(wake, 1) != bytes([signal.SIGINT]) or signal.getsignal(signal.SIGINT) is not _interrupt:
            pass  # another signal, or an interrupt for which the program has installed another handler
        time.sleep(GRACE)
        end()

    threading.Thread(target=watch, daemon=True).start()


def was_interrupted() -> bool:
    """Return whether an interrupt has arrived. Other libraries may have replaced its exception by theirs."""
    return _interrupted.is_set()


def end() -> None:
    """End the program and its worker processes at once."""
    multiprocessing = sys.modules.get("multiprocessing")  # importing it could wait for an unfinished import
    for worker in getattr(multiprocessing, "active_children", list)():
        worker.kill()
        worker.join(GRACE)
    if sys.stderr.isatty():
        os.write(2, b"\x1b[?25h")  # a progress bar hides the cursor
    os._exit(INTERRUPTED)


def _interrupt(_: int, frame: FrameType | None) -> None:
    """End the program in order or, during an import, at once: an exception may abort a compiled module."""
    _interrupted.set()
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            end()
        frame = frame.f_back
    sys.exit(INTERRUPTED)
