"""gamesr-serve: what a sweep's store holds, over HTTP and on a page; and sweeps that are started over HTTP."""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import socket
import tempfile
import traceback
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path
from types import FrameType

from client.command import command_parser, fail, fail_on_file, open_streams, whole_number
from client.errors import GamesrError, InputError, OutputError, how_to_install
from server.guards import is_loopback, is_public_name
from server.runner import RunnerProcess, add_folders, check_clips_folder
from server.settings import Settings

PROGRAM = "gamesr-serve"
KEY_VARIABLE = "GAMESR_API_KEY"
LEAST_KEY = 16
DEMO = Path(__file__).parent / "demo"
EXAMPLES = f"""\
examples:
  gamesr-serve --demo
      a sweep that ships with this, on http://127.0.0.1:8060/; what is changed is gone at the end
  gamesr-serve --store gamesr-sweep.sqlite --clips footage
      what gamesr-sweep measured into its store; the clips of footage/ may be swept
  {KEY_VARIABLE}=$(openssl rand -hex 16) gamesr-serve --host 0.0.0.0
      for others too; what changes something is taken with that key only, in the header X-API-Key

Everyone who can reach the service may read: results, clips' names and pictures. The key, of at least {LEAST_KEY} characters, is
for what changes something: sweeps, uploads, posted latencies. Sweeps run one at a time, each in a process of its own at nice
10; one that was running when the service ended goes on when it is started again. For TLS, put a proxy in front of it: with
--public-name the service answers to that name too. Exit status: 0 ended, 1 refused (one sentence says why), 2 wrong usage.
"""


def parser() -> argparse.ArgumentParser:
    parser = command_parser(PROGRAM, "Serve what sweeps measured, as JSON, as Prometheus metrics and as a page.", EXAMPLES)
    add_folders(parser)
    parser.add_argument("--host", metavar="ADDRESS", default="127.0.0.1", help="where to listen (default: %(default)s)")
    parser.add_argument("--port", metavar="N", type=whole_number(0, 65535), default=8060, help="the port there (default: %(default)s)")
    parser.add_argument("--public-name", metavar="HOST[:PORT]", help="what a proxy on this machine offers the service as; needs a key")
    parser.add_argument("--demo", action="store_true", help="open on the sample sweep, in a folder that is removed at the end")
    parser.add_argument("--no-runner", action="store_true", help="sweeps are run by a gamesr-runner, elsewhere on the same folders")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    open_streams()
    arguments = parser().parse_args(argv)
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, _interrupt)
    try:
        with ExitStack() as stack:
            if arguments.demo:
                _demo(arguments, Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gamesr-serve-"))))
            serve(arguments)
    except KeyboardInterrupt:
        return 0
    except GamesrError as error:
        if arguments.debug:
            traceback.print_exc()
        return fail(PROGRAM, str(error))
    except OSError as error:
        if arguments.debug:
            traceback.print_exc()
        return fail_on_file(PROGRAM, error)
    return 0


def settings_of(arguments: argparse.Namespace, key: str | None) -> Settings:
    """Raises InputError for what would not be safe."""
    loopback = is_loopback(arguments.host)
    if key is None and not loopback:
        raise InputError(f"on {arguments.host} others could start sweeps: set {KEY_VARIABLE}, or leave out --host")
    public_name = arguments.public_name and arguments.public_name.lower()
    if public_name is not None and not is_public_name(public_name):
        raise InputError(f"{arguments.public_name} is not the name of a host: --public-name has neither https:// nor a path")
    if key is None and public_name is not None:
        raise InputError(f"as {public_name} others could start sweeps: set {KEY_VARIABLE}, or leave out --public-name")
    if key is not None and (len(key) < LEAST_KEY or not key.isascii() or not key.isprintable()):
        raise InputError(f"{KEY_VARIABLE} must be {LEAST_KEY} printable characters or more: openssl rand -hex 16 makes one")
    check_clips_folder(arguments.clips)
    return Settings(
        arguments.store, arguments.data, arguments.clips, api_key=key, loopback=loopback, jobs=arguments.jobs, public_name=public_name
    )


def serve(arguments: argparse.Namespace) -> None:
    """Until a signal comes; raises GamesrError where it cannot begin."""
    # Out of the environment: what decodes anybody's clips has no need to know it.
    settings = settings_of(arguments, os.environ.pop(KEY_VARIABLE, None) or None)
    try:
        import uvicorn

        from server.app import create_app  # not above: without its packages the sentence below has to come
        from server.connections import bounded_protocol
    except ModuleNotFoundError as error:
        raise OutputError(f"the service needs {error.name}: {how_to_install('serve')}") from error
    app = create_app(settings)
    with _bind(arguments.host, arguments.port) as listener:
        host, port = listener.getsockname()[:2]
        with nullcontext() if arguments.no_runner else RunnerProcess(replace(settings, api_key=None)):
            print(f"{PROGRAM}: http://{f'[{host}]' if ':' in host else host}:{port}/", flush=True)
            # No proxy's word is taken for where a request comes from, and open event streams do not hold up the end.
            config = uvicorn.Config(
                app,
                http=bounded_protocol(settings.limits),
                ws="none",
                log_level="warning",
                server_header=False,
                proxy_headers=False,
                timeout_graceful_shutdown=2,
            )
            uvicorn.Server(config).run([listener])


def _bind(host: str, port: int) -> socket.socket:
    try:
        listener = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
        # asyncio does this only where the socket names its protocol. Without it every answer waits 40 ms for the client to
        # acknowledge its head before its body goes out. What is accepted inherits it.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return listener
    except OSError as error:
        raise OutputError(f"cannot listen on {host} port {port}: {error.strerror}; name another with --host or --port") from error


def _demo(arguments: argparse.Namespace, folder: Path) -> None:
    """The sample sweep beside its clip, in a folder that may be written to; raises InputError where others are named, too."""
    for name in ("store", "data", "clips"):
        if getattr(arguments, name) != parser().get_default(name):
            raise InputError(f"--demo has a store, a folder and a clip of its own: leave out --{name}, or --demo")
    try:
        shutil.copyfile(DEMO / "sweep.sqlite", folder / "sweep.sqlite")
    except OSError as error:
        raise InputError(f"the sample sweep cannot be copied to {folder}: {error.strerror}") from error
    arguments.store, arguments.data, arguments.clips = folder / "sweep.sqlite", folder / "data", DEMO


def _interrupt(signum: int, frame: FrameType | None) -> None:
    # A second signal must not stop the runner from being stopped.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise KeyboardInterrupt
