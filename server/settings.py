"""How a service is set up, and what bounds it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

MIB = 2**20


@dataclass(frozen=True)
class Limits:
    """What one caller, or all of them together, may take. Uploads are decoded whole, in a process that `decode_*` bound."""

    body_bytes: int = 64 * 1024  # of everything but an upload
    body_s: float = 30.0
    connections_at_once: int = 256
    idle_s: float = 10.0  # between two pieces of a body, and for the head of a request
    upload_bytes: int = 512 * MIB
    upload_s: float = 600.0
    uploads_at_once: int = 2
    uploads_kept: int = 32
    clip_s: float = 60.0
    clip_frames: int = 7200
    clip_pixels: int = 4096 * 2304  # of one picture
    decode_s: int = 60
    decode_bytes: int = 3 * 1024 * MIB  # address space
    queued_sweeps: int = 8
    kept_sweeps: int = 200
    kept_client_latencies: int = 10_000
    events_at_once: int = 64
    events_s: float = 600.0
    frame_last: int = 599
    frame_s: int = 600  # of a processor
    frames_at_once: int = 8
    frames_kept_bytes: int = 256 * MIB


@dataclass(frozen=True)
class Settings:
    """`store` is gamesr-sweep's file, `data` the service's own folder, `clips` the folder whose clips may be named.

    `api_key` is what changes have to be sent with; None asks for none, and is for loopback only. `loopback` says that only
    this machine is meant to reach the service, `public_name` under which name a proxy on it lets others do so. `jobs` are the
    worker processes of a sweep.
    """

    store: Path
    data: Path
    clips: Path | None
    api_key: str | None = field(repr=False)
    loopback: bool
    jobs: int
    public_name: str | None = None
    limits: Limits = Limits()

    @property
    def uploads(self) -> Path:
        return self.data / "uploads"

    @property
    def frames(self) -> Path:
        return self.data / "frames"

    @property
    def database(self) -> Path:
        return self.data / "service.sqlite"
