"""How every command ends: one sentence for what went wrong, a status, and nothing left behind by a signal."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import traceback
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import FrameType

from client.errors import GamesrError


def command_parser(program: str, description: str, epilog: str) -> argparse.ArgumentParser:
    """A parser whose help keeps the lines of `epilog`, with the options that every command has."""
    parser = argparse.ArgumentParser(
        prog=program, description=description, epilog=epilog, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--version", action="version", version=f"{program}, of GameSR {_version()}")
    parser.add_argument("--debug", action="store_true", help="show where an error came from")
    return parser


def run_command(program: str, work: Callable[[], int | None], *, debug: bool, interrupted: str = "interrupted") -> int:
    """Do a command's work; returns the exit status, and prints `program` and one sentence to stderr where that is not the work's own.

    1 for a GamesrError, a file that cannot be read or written, or when whoever reads the output has gone; 130 for Ctrl-C, SIGTERM and
    SIGHUP, which raise KeyboardInterrupt once: a second one must not stop what the first one made the work clear up.
    """
    open_streams()
    on_signals(_interrupt)
    try:
        status = work() or 0
        sys.stdout.flush()  # what is lost at the interpreter's end is a traceback of its own
        return status
    except KeyboardInterrupt:
        return fail(program, interrupted, 130)
    except GamesrError as error:
        if debug:
            traceback.print_exc()
        return fail(program, str(error))
    except BrokenPipeError:
        return reader_gone()
    except MemoryError:
        return fail(program, "there is not enough memory for this: ask for fewer or smaller pictures")
    except OSError as error:
        if debug:
            traceback.print_exc()
        return fail_on_file(program, error)


def fail(program: str, sentence: str, status: int = 1) -> int:
    """Say why a command ends with that status."""
    print(f"{program}: {sentence}", file=sys.stderr)
    return status


def fail_on_file(program: str, error: OSError) -> int:
    """Say what could not be read or written; where it has no name it may be stdout."""
    _drop_output()
    return fail(program, f"{error.filename}: {error.strerror}" if error.filename else str(error))


def reader_gone() -> int:
    """Whoever read the output has gone."""
    _drop_output()
    return 1


def _drop_output() -> None:
    """What is still to be written to stdout goes nowhere: the interpreter would complain when it flushes at its end."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def open_streams() -> None:
    """Those that whoever started the program closed are None; what is meant for them goes nowhere, and not into the next file opened."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode))  # noqa: SIM115 - for as long as the program runs


def on_signals(handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
    """What Ctrl-C, SIGTERM and a terminal that closes (SIGHUP) do; under nohup the last goes on doing nothing."""
    hangup = getattr(signal, "SIGHUP", None)  # not in Windows
    if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:
        signal.signal(hangup, handler)
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, handler)


def whole_number(least: int = 1, most: int = 1_000_000_000) -> Callable[[str], int]:
    """An argument's type: a whole number from `least` to `most`."""

    def parse(text: str) -> int:
        try:
            if least <= int(text) <= most:
                return int(text)
        except ValueError:
            pass
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from {least} to {most}")

    return parse


def _interrupt(signum: int, frame: FrameType | None) -> None:
    on_signals(signal.SIG_IGN)
    raise KeyboardInterrupt


def _version() -> str:
    try:
        return version("gamesr")
    except PackageNotFoundError:
        return "that is not installed"
