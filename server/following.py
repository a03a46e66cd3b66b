"""Processes that end when the one that started them does, however that happens."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from types import FrameType

_AGAIN_S = 0.01


def end_with_parent() -> None:
    """For the first line of a process: SIGTERM, and the parent's end, leave it as an exception, so that contexts are left too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent hears it too, and ends this process
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _leave(signum: int, frame: FrameType | None) -> None:
    below = frame
    while below is not None:
        if below.f_code.co_name == "__del__":  # an exception would be lost in it: a moment later, then
            threading.Timer(_AGAIN_S, os.kill, (os.getpid(), signum)).start()
            return
        below = below.f_back
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one must not stop what the first one began to put away
    sys.exit(128 + signum)


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
