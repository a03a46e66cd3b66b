"""Processes that are told to end, at whatever moment."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

PROGRAM = """
import time
from server.following import end_with_parent
end_with_parent()
class Slow:
    def __del__(self):
        print("being deleted", flush=True)
        time.sleep(0.3)
Slow()
time.sleep(60)
"""


def test_told_to_end_in_the_middle_of_a_deletion_it_still_ends_and_without_a_word() -> None:
    command = [sys.executable, "-c", PROGRAM]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parent.parent) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        assert (process.wait(30), process.stderr.read()) == (128 + signal.SIGTERM, "")
