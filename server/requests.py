"""What a caller may send to the service, and what comes back of it: clips, sweeps to run, latencies of players."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator
from pydantic.config import JsonDict

from server.schemas import Deadline, Schema, StageLatency

NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,95}$"
ClipName = Annotated[str, Field(pattern=NAME, description="as /api/v1/clips lists it")]
UpscalerName = Annotated[str, Field(pattern=NAME, description="none for native resolution, or a model of /api/v1/models")]


def _whole(value: object) -> object:
    """JSON has one kind of number: 2.0 is a whole one."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


WholeNumber = Annotated[int, BeforeValidator(_whole)]
Kbps = Annotated[WholeNumber, Field(ge=1, le=1_000_000)]
Lines = Annotated[WholeNumber, Field(ge=2, le=8192)]
Scale = Annotated[WholeNumber, Field(ge=2, le=3)]


def _distinct(values: list[Any]) -> list[Any]:
    if len(set(values)) < len(values):
        raise ValueError("names the same twice")
    return values


_UNIQUE: JsonDict = {"uniqueItems": True}
_DISTINCT = AfterValidator(_distinct)


class Sent(Schema):
    """Nothing is guessed: an unknown field or a value of another type is refused."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False, extra="forbid", strict=True)


_SWEEP: dict[str, Any] = {
    "clips": ["oa_koth1.mp4"],
    "bitrates_kbps": [500, 1000, 2000, 4000],
    "upscalers": ["none", "bicubic", "gamesr"],
    "scales": [2],
    "frames": 60,
}


class SweepRequest(Sent):
    """A sweep to run. Heights must be the whole, a half or a third of each clip's height; null means those that `scales` name.

    `scales` are 2 for half and 3 for a third of whatever height a clip has; null means both, where the clip has them.
    """

    model_config = ConfigDict(json_schema_extra={"examples": [_SWEEP]})

    clips: Annotated[list[ClipName], Field(min_length=1, max_length=8, json_schema_extra=_UNIQUE), _DISTINCT]
    bitrates_kbps: Annotated[list[Kbps], Field(min_length=1, max_length=16, json_schema_extra=_UNIQUE), _DISTINCT] = Field(
        default_factory=lambda: [2000, 4000, 6000, 8000, 13000, 20000, 25000]
    )
    upscalers: Annotated[list[UpscalerName], Field(min_length=1, max_length=16, json_schema_extra=_UNIQUE), _DISTINCT] = Field(
        default_factory=lambda: ["none", "bicubic", "lanczos", "fsr1", "gamesr"]
    )
    low_heights: Annotated[list[Lines], Field(min_length=1, max_length=4, json_schema_extra=_UNIQUE), _DISTINCT] | None = None
    scales: Annotated[list[Scale], Field(min_length=1, max_length=2, json_schema_extra=_UNIQUE), _DISTINCT] | None = None
    fps: Annotated[WholeNumber, Field(ge=1, le=1000, description="a whole part of the clips' own rate, null for that rate")] | None = None
    frames: Annotated[WholeNumber, Field(ge=1, le=1_000_000, description="the most of a clip that count, null for all")] | None = None

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if self.low_heights is not None and self.scales is not None:
            raise ValueError("low_heights and scales say the same in two ways: send one of them")
        return self


class StoredClip(Schema):
    """A clip that can be swept. `origin` is the configured folder or an upload."""

    name: str = Field(description="what every other address takes")
    origin: Literal["folder", "upload"]
    title: str = Field(description="what the uploader called it; the name where nobody did")
    size_bytes: int
    sha256: str
    width: int
    height: int
    fps: int
    frames: int
    duration_s: float
    low_heights: list[int] = Field(description="heights it can be encoded at: the whole, half and third that 4:2:0 can hold")


class ClipList(Schema):
    clips: list[StoredClip]
    refused: dict[str, str] = Field(description="files of the folder that cannot be used: why")


class StageLatencySent(Sent):
    """Percentiles in microseconds over `count` frames; they rise."""

    count: Annotated[WholeNumber, Field(ge=1, le=10**9)]
    p50: Annotated[float, Field(ge=0, le=1e9)]
    p95: Annotated[float, Field(ge=0, le=1e9)]
    p99: Annotated[float, Field(ge=0, le=1e9)]
    max: Annotated[float, Field(ge=0, le=1e9)]

    @model_validator(mode="after")
    def _rise(self) -> Self:
        if not self.p50 <= self.p95 <= self.p99 <= self.max:
            raise ValueError("p50, p95, p99 and max must not fall")
        return self


class StagesSent(Sent):
    """By stage; `total` is from the packet to the picture that was handed over."""

    decode: StageLatencySent | None = None
    upscale: StageLatencySent | None = None
    write: StageLatencySent | None = None
    total: StageLatencySent


Word = Annotated[str, Field(min_length=1, max_length=120, pattern=r"^[ -~]+$")]


_PLAYED: dict[str, Any] = {
    "model": "gamesr",
    "model_sha256": "0" * 64,
    "provider": "cpu",
    "threads": 2,
    "machine": "my laptop",
    "low_width": 960,
    "low_height": 540,
    "scale": 2,
    "latency_us": {"total": {"count": 600, "p50": 9100, "p95": 12000, "p99": 19000, "max": 31000}},
    "deadline_misses": {"30": 0, "60": 9, "120": 420},
}


class ClientLatencyRequest(Sent):
    """What a player's client saw while it played. `latency_us` and `deadline_misses` are as the client's own summary has them."""

    model_config = ConfigDict(json_schema_extra={"examples": [_PLAYED]})

    model: Annotated[str, Field(pattern=NAME)]
    model_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    precision: Annotated[str, Field(pattern=NAME)] = "float32"
    provider: Literal["cpu", "cuda", "cuda-tf32", "openvino", "openvino-bfloat16", "openvino-float16"]
    threads: Annotated[WholeNumber, Field(ge=1, le=1024)]
    machine: Word
    low_width: Annotated[WholeNumber, Field(ge=1, le=8192)]
    low_height: Annotated[WholeNumber, Field(ge=1, le=8192)]
    scale: Scale
    latency_us: StagesSent
    deadline_misses: dict[Literal["30", "60", "120"], Annotated[WholeNumber, Field(ge=0, le=10**9)]] = Field(
        description="frames that took longer in total than one frame lasts, by frame rate"
    )

    @model_validator(mode="after")
    def _no_more_than_all(self) -> Self:
        if any(missed > self.latency_us.total.count for missed in self.deadline_misses.values()):
            raise ValueError("more frames missed a deadline than there were")
        return self


class ClientLatency(Schema):
    """What a player's client posted."""

    id: str
    received_at: float = Field(description="seconds since 1970 in UTC")
    model: str
    model_sha256: str
    precision: str
    provider: str
    threads: int
    machine: str
    width: int
    height: int
    low_width: int
    low_height: int
    scale: int
    frames: int
    latency_us: dict[str, StageLatency]
    deadlines: list[Deadline]


class ClientLatencyList(Schema):
    """The newest first, at most 200."""

    latencies: list[ClientLatency]


class Artifact(Schema):
    """One shipped model at one scale, as the artifact describes itself, with its card."""

    name: str
    scale: int
    precision: str
    size_multiple: int
    size_bytes: int
    sha256: str
    recurrent: bool
    card: dict[str, Any] = Field(description="facts that the exporter wrote")
    card_markdown: str | None = Field(description="the card for people, null where there is none")


class ModelList(Schema):
    models: list[Artifact]


class Health(Schema):
    """`status` is ok, or what is wrong; `runner` says whether sweeps are being run."""

    status: str
    runner: bool
    version: str
