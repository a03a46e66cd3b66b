"""A trial: does what the decoder knows help? The state aligned by motion vectors, and tiles left to bicubic."""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
from av.codec.context import Flags
from numpy.typing import NDArray

from client.cloud import CloudEncoder, CloudSettings, area_downscale
from client.detail import SQUARE, DetailUpscaler, gradient_energy, most_detailed
from client.frames import Frame
from client.models import find_model
from client.pipeline import Upscaler
from client.quality import Quality, QualityMeter, psnr_db
from client.tiles import Box, Mask, TileGrid
from client.upscaler import OnnxUpscaler, State
from client.video import VideoSource, from_av_frame
from server.encoding import clip_frames

BLOCK = 8  # luma pixels: the finest block that the decoder gives a vector of
MACROBLOCK = 16
Values = NDArray[np.float64]
Flow = NDArray[np.float32]


@dataclass(frozen=True)
class Known:
    """A decoded frame and what the decoder knew of it.

    `flow` is float32 (2, blocks down, blocks across): rows and columns, in luma pixels, from a block of 8x8 to where it was predicted
    from; NaN where it is intra. `qp` is (macroblocks down, across).
    """

    frame: Frame
    flow: Flow
    qp: NDArray[np.int32]

    def cut(self, box: Box) -> Known:
        y, u, v = self.frame.y, self.frame.u, self.frame.v
        chroma = box.slices(divide=2)
        frame = replace(self.frame, y=y[box.slices()], u=u[chroma], v=v[chroma])
        return Known(frame, self.flow[(slice(None), *box.slices(divide=BLOCK))], self.qp[box.slices(divide=MACROBLOCK)])


def decoded(frames: Iterable[Frame], settings: CloudSettings) -> Iterator[Known]:
    """Each frame through the cloud's encoder and a decoder that gives out its vectors and quantisers."""
    decoder = av.CodecContext.create("h264", "r")
    decoder.thread_count = 1
    decoder.flags |= Flags.low_delay
    decoder.options = {"flags2": "+export_mvs", "export_side_data": "venc_params"}
    encoder: CloudEncoder | None = None
    for frame in frames:
        encoder = encoder or CloudEncoder(settings, frame.width, frame.height, frame.colour)
        for packet in encoder.encode(frame):
            for picture in decoder.decode(av.Packet(packet)):
                side_data = cast("Mapping[str, Any]", picture.side_data)  # the stub knows of motion vectors only
                down, across = -(-frame.height // MACROBLOCK), -(-frame.width // MACROBLOCK)
                vectors = side_data.get("MOTION_VECTORS")
                flow = block_flow(vectors.to_ndarray() if vectors else None, (2 * down, 2 * across))
                qp = side_data["VIDEO_ENC_PARAMS"].qp_map().reshape(down, across)
                yield Known(from_av_frame(picture), flow, qp)


def block_flow(vectors: NDArray[np.void] | None, shape: tuple[int, int]) -> Flow:
    flow = np.full((2, *shape), np.nan, np.float32)
    if vectors is None:
        return flow
    for height in (8, 16):
        for width in (8, 16):
            some = vectors[(vectors["h"] == height) & (vectors["w"] == width)]
            rows, columns = (some["dst_y"] - height // 2) // BLOCK, (some["dst_x"] - width // 2) // BLOCK
            for down in range(height // BLOCK):
                for across in range(width // BLOCK):
                    flow[0, rows + down, columns + across] = some["motion_y"] / some["motion_scale"]
                    flow[1, rows + down, columns + across] = some["motion_x"] / some["motion_scale"]
    return flow


def aligned(planes: NDArray[np.float32], flow: Flow, divisor: int, *, bilinear: bool) -> NDArray[np.float32]:
    """(C, h, w) at 1/divisor of the luma's size, each block taken from where its vector points; intra blocks stay."""
    channels, height, width = planes.shape
    side = BLOCK // divisor
    cells = np.nan_to_num(flow / divisor).repeat(side, 1).repeat(side, 2)[:, :height, :width]
    flat = planes.reshape(channels, -1)
    rows = np.clip(cells[0] + np.arange(height, dtype=np.float32)[:, None], 0, height - 1)
    columns = np.clip(cells[1] + np.arange(width, dtype=np.float32), 0, width - 1)
    if not bilinear:
        index = np.rint(rows).astype(np.int64) * width + np.rint(columns).astype(np.int64)
        return np.asarray(flat.take(index.ravel(), 1).reshape(planes.shape))
    top, left = np.floor(rows).astype(np.int64), np.floor(columns).astype(np.int64)
    below, right = np.minimum(top + 1, height - 1), np.minimum(left + 1, width - 1)
    total = np.zeros_like(flat)
    for y, down in ((top, 1 - (rows - top)), (below, rows - top)):
        for x, across in ((left, 1 - (columns - left)), (right, columns - left)):
            total += flat.take((y * width + x).ravel(), 1) * (down * across).ravel()
    return total.reshape(planes.shape)


@dataclass(frozen=True)
class Way:
    """What is done to the state before a step, and which squares of 64 pixels are computed: all, or those with most gradient energy.

    `parts` are those aligned, of h and c. `rest` says what becomes of the state of a square that is left to bicubic.
    """

    name: str
    parts: str = ""
    bilinear: bool = False
    intra_zeroed: bool = False
    restarted: bool = False
    rest: str | None = None
    share: float = 1.0


WAYS = (
    Way("as it is"),
    Way("from zeros every frame", restarted=True),
    Way("nearest, h and c", "hc"),
    Way("bilinear, h and c", "hc", bilinear=True),
    Way("bilinear, h", "h", bilinear=True),
    Way("bilinear, c", "c", bilinear=True),
    Way("bilinear, h and c, intra zeroed", "hc", bilinear=True, intra_zeroed=True),
)
CHOICES = tuple(
    Way(f"{share:.0%} of the squares, the others' state {rest}", rest=rest, share=share)
    for share in (0.25, 0.5)
    for rest in ("computed", "frozen", "zeroed")
)


def prepare(state: State, upscaler: OnnxUpscaler, flow: Flow, way: Way) -> None:
    for spec, array in zip(upscaler.spec.state, state.tensors(), strict=True):
        if way.restarted:
            array[:] = 0
        if spec.input[0] in way.parts:
            array[0] = aligned(array[0], flow, spec.divisor, bilinear=way.bilinear)
        if way.intra_zeroed:
            side = BLOCK // spec.divisor
            intra = np.isnan(flow[0]).repeat(side, 0).repeat(side, 1)[: array.shape[2], : array.shape[3]]
            array[:, :, intra] = 0


def play(clip: Sequence[Known], upscaler: OnnxUpscaler, bicubic: OnnxUpscaler, way: Way) -> Iterator[Frame]:
    height, width = clip[0].frame.height, clip[0].frame.width
    state = upscaler.initial_state(height, width)
    for known in clip:
        prepare(state, upscaler, known.flow, way)
        before = [array.copy() for array in state.tensors()]
        picture, state = upscaler.step(known.frame, state)
        if way.rest:
            left = ~most_detailed(known.frame.y, SQUARE, way.share)
            base, _ = bicubic.step(known.frame, bicubic.initial_state(height, width))
            picture = replace(
                picture,
                **{p: np.where(spread(left, 2 * SQUARE // d, getattr(base, p)), getattr(base, p), getattr(picture, p)) for p, d in PLANES},
            )
            for spec, old, array in zip(upscaler.spec.state, before, state.tensors(), strict=True):
                cells = spread(left, SQUARE // spec.divisor, array[0, 0])
                if way.rest != "computed":
                    array[:, :, cells] = old[:, :, cells] if way.rest == "frozen" else 0
        yield picture


PLANES = (("y", 1), ("u", 2), ("v", 2))


def spread(tiles: Mask, side: int, plane: NDArray[np.generic]) -> Mask:
    return tiles.repeat(side, 0).repeat(side, 1)[: plane.shape[0], : plane.shape[1]]


def tile_means(values: NDArray[np.generic], side: int) -> Values:
    """The mean over each square of `side`; at the right and lower edge of what there is of it."""
    starts = [np.arange(0, size, side) for size in values.shape]
    total = np.add.reduceat(np.add.reduceat(values.astype(np.float64), starts[0], 0), starts[1], 1)
    counts = [np.diff(np.append(start, size)) for start, size in zip(starts, values.shape, strict=True)]
    return np.asarray(total / (counts[0][:, None] * counts[1]))


def most(score: Values, share: float) -> Mask:
    """The `share` of tiles with the highest score."""
    chosen = np.zeros(score.size, bool)
    chosen[np.argsort(-score, axis=None, kind="stable")[: round(share * score.size)]] = True
    return chosen.reshape(score.shape)


def scores(known: Known, last: Known, gain: Values, change: Values, generator: np.random.Generator) -> dict[str, Values]:
    """What a tile may be chosen by, the greater the better; the first two need the network's picture, the first the reference too."""
    y = known.frame.y.astype(np.float32)
    detail = gradient_energy(known.frame.y, 32)
    around = np.pad(y, 1, mode="edge")
    smooth = (around[1:-1, :-2] + around[1:-1, 2:] + around[:-2, 1:-1] + around[2:, 1:-1]) / 4
    length = tile_means(np.nan_to_num(np.hypot(*known.flow)).repeat(BLOCK, 0).repeat(BLOCK, 1)[: y.shape[0], : y.shape[1]], 32)
    qp = tile_means(known.qp.repeat(MACROBLOCK, 0).repeat(MACROBLOCK, 1)[: y.shape[0], : y.shape[1]], 32)
    old = last.frame.y.astype(np.float32)
    residual = tile_means((y - aligned(old[None], known.flow, 1, bilinear=True)[0]) ** 2, 32)
    return {
        "oracle: the gain": gain,
        "oracle: network minus bicubic": change,
        "gradient energy": detail,
        "variance": tile_means(y * y, 32) - tile_means(y, 32) ** 2,
        "second difference": tile_means((y - smooth) ** 2, 32),
        "gradient energy over quantiser": detail / 2 ** (qp / 3),
        "long vectors": length,
        "short vectors": -length,
        "high QP": qp,
        "low QP": -qp,
        "large residual": residual,
        "small residual": -residual,
        "gradient energy, less residual": detail - 2 * residual,
        "chance": generator.random(detail.shape),
    }


def area(known: Known, upscaler: OnnxUpscaler, chosen: Mask) -> float:
    """The share of the frame that goes through the network, halos included."""
    spec = upscaler.spec
    height, width = spec.padded(known.frame.height), spec.padded(known.frame.width)
    assert spec.reach is not None
    windows = TileGrid(height, width, spec.size_multiple, spec.reach).windows(chosen)
    if windows is None:
        return 1.0
    return sum((w.outer.bottom - w.outer.top) * (w.outer.right - w.outer.left) for w in windows) / (height * width)


def coarse(score: Values, side: int, share: float) -> Mask:
    """Chosen in squares of `side` tiles."""
    return spread(most(tile_means(score, side), share), side, score)


def rectangle(score: Values, share: float, shapes: Iterable[tuple[int, int]] | None = None) -> Mask:
    """The one rectangle with the greatest sum: of `shapes`, or of all that hold at most `share` of the tiles."""
    rows, columns = score.shape
    total = np.pad(score.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    best, chosen = -math.inf, np.zeros(score.shape, bool)
    for height, width in shapes or [(height, min(columns, int(share * score.size) // height)) for height in range(1, rows + 1)]:
        if not width:
            continue
        sums = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
        if sums.max() > best:
            best = float(sums.max())
            top, left = np.unravel_index(sums.argmax(), sums.shape)
            chosen[:] = False
            chosen[top : top + height, left : left + width] = True
    return chosen


def rectangles(score: Values, share: float) -> dict[str, Mask]:
    rows, columns = score.shape
    band, side = [(round(share * rows), columns)], [(round(math.sqrt(share) * rows), round(math.sqrt(share) * columns))]
    return {
        "gradient energy, one rectangle": rectangle(score, share),
        "gradient energy, one band as wide as the frame": rectangle(score, share, band),
        "gradient energy, one rectangle of the frame's shape": rectangle(score, share, side),
    }


def tiles_trial(title: str, clip: Sequence[Known], references: Sequence[Frame], upscaler: OnnxUpscaler, bicubic: OnnxUpscaler) -> None:
    """Squared error of every tile under both, then every choice made of them; the state is computed everywhere."""
    bases = play(clip, bicubic, bicubic, WAYS[0])
    generator = np.random.default_rng(0)
    shares = (0.25, 0.5, 0.75)
    sums: dict[tuple[str, float], Values] = {}
    network_sum = base_sum = 0.0
    ours_played = play(clip, upscaler, bicubic, WAYS[0])
    for index, (known, picture, base, reference) in enumerate(zip(clip, ours_played, bases, references, strict=True)):
        truth, ours, theirs = (frame.y.astype(np.float64) for frame in (reference, picture, base))
        network, plain = tile_means((ours - truth) ** 2, 64), tile_means((theirs - truth) ** 2, 64)
        sizes = area_of_tiles(truth.shape)
        network_sum, base_sum = network_sum + float((network * sizes).sum()), base_sum + float((plain * sizes).sum())
        ranked = scores(known, clip[max(index - 1, 0)], (plain - network) * sizes, tile_means((ours - theirs) ** 2, 64), generator)
        for share in shares:
            chosen = {name: most(score, share) for name, score in ranked.items()}
            detail = ranked["gradient energy"]
            chosen |= {f"gradient energy, squares of {32 * side}": coarse(detail, side, share) for side in (2, 4)}
            chosen |= rectangles(detail, share)
            for name, mask in chosen.items():
                error = float((np.where(mask, network, plain) * sizes).sum())
                computed = area(known, upscaler, mask) if "gradient energy" in name else math.nan  # finding windows takes its time
                sums[name, share] = sums.get((name, share), np.zeros(2)) + np.array((error, computed))
    samples = references[0].y.size * len(clip)
    low, high = psnr_db(base_sum / samples), psnr_db(network_sum / samples)
    print(f"\n{title}: bicubic {low:.3f} dB, {upscaler.spec.name} {high:.3f} dB; gain kept (area computed) at {shares}", flush=True)
    for name in dict.fromkeys(key[0] for key in sums):
        cells = []
        for share in shares:
            error, computed = sums[name, share]
            through = "" if math.isnan(computed) else f" ({100 * computed / len(clip):.0f}%)"
            cells.append(f"{100 * (psnr_db(error / samples) - low) / (high - low):.0f}%{through}")
        print(f"| {title} | {upscaler.spec.name} | {name} | " + " | ".join(cells) + " |", flush=True)


def area_of_tiles(shape: tuple[int, ...]) -> Values:
    counts = [np.diff(np.append(np.arange(0, size, 64), size)) for size in shape]
    return np.asarray(counts[0][:, None] * counts[1], np.float64)


def alignment_trial(
    title: str, clip: Sequence[Known], references: Sequence[Frame], upscaler: OnnxUpscaler, bicubic: OnnxUpscaler, ways: Sequence[Way]
) -> None:
    inter = np.mean([~np.isnan(known.flow[0]) for known in clip[1:]])
    length = np.nanmean([np.hypot(*known.flow) for known in clip[1:]])
    errors = np.zeros(2)
    for last, known in itertools.pairwise(clip):
        y, old = known.frame.y.astype(np.float32), last.frame.y.astype(np.float32)
        errors += np.mean((y - old) ** 2), np.mean((y - aligned(old[None], known.flow, 1, bilinear=True)[0]) ** 2)
    still, moved = (psnr_db(error / (len(clip) - 1)) for error in errors)
    print(f"\n{title}: vectors of {length:.1f} pixels, {1 - inter:.1%} intra; last luma {still:.2f} dB, aligned {moved:.2f}", flush=True)
    pairs = [(Way("bicubic"), bicubic), *((way, upscaler) for way in ways)]
    for way, used in pairs:
        quality = measured(references, play(clip, used, bicubic, way))
        cells = (quality.psnr_y_db, quality.temporal_error, quality.vmaf_neg, quality.psnr_u_db, quality.psnr_v_db)
        row = " | ".join("" if cell is None else f"{cell:.3f}" for cell in cells)
        print(f"| {title} | {used.spec.name} | {way.name} | {row} |", flush=True)


def measured(references: Sequence[Frame], pictures: Iterable[Frame]) -> Quality:
    with QualityMeter(references[0].width, references[0].height, vmaf_threads=1) as meter:
        for reference, picture in zip(references, pictures, strict=True):
            meter.add(reference, picture)
        return meter.result()


def detail_trial(title: str, clip: Sequence[Known], references: Sequence[Frame], upscaler: OnnxUpscaler, bicubic: OnnxUpscaler) -> None:
    """The upscaler that computes only squares of detail, on the clip: quality, squares computed, processor time of a step."""
    ways: dict[str, Upscaler[Any]] = {"bicubic": bicubic, "whole": upscaler}
    ways |= {f"detail {share}": DetailUpscaler(upscaler, bicubic, share) for share in (0.125, 0.25, 0.5)}
    for name, way in ways.items():
        times_ms, shares, pictures = [], [], []
        state = way.initial_state(clip[0].frame.height, clip[0].frame.width)
        for known in clip:
            begin_ns = time.process_time_ns()
            picture, state = way.step(known.frame, state)
            times_ms.append((time.process_time_ns() - begin_ns) / 1e6)
            shares.append(state.computed_share)
            pictures.append(picture)
        quality = measured(references, pictures)
        cells = (quality.psnr_y_db, quality.temporal_error, quality.vmaf_neg, 100 * np.mean(shares), np.median(times_ms[1:]))
        row = " | ".join("" if cell is None else f"{cell:.3f}" for cell in cells)
        print(f"| {title} | {upscaler.spec.name} | {name} | {row} |", flush=True)


def speed_trial(clip: Sequence[Known]) -> None:
    """Processor time of what the trials add to a frame, at the clip's size: the median of the frames."""
    height, width = clip[0].frame.height, clip[0].frame.width
    state = np.random.default_rng(0).random((32, height // 2, width // 2), np.float32)
    works: dict[str, Callable[[Known], object]] = {
        "nearest, one of h and c": lambda known: aligned(state, known.flow, 2, bilinear=False),
        "bilinear, one of h and c": lambda known: aligned(state, known.flow, 2, bilinear=True),
        "gradient energy of the squares": lambda known: gradient_energy(known.frame.y, SQUARE),
    }
    for name, work in works.items():
        times_ms = []
        for known in clip[1:]:
            begin_ns = time.process_time_ns()
            work(known)
            times_ms.append((time.process_time_ns() - begin_ns) / 1e6)
        print(f"| {name} | {width}x{height} | {np.median(times_ms):.2f} ms |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("trial", choices=("alignment", "choices", "tiles", "detail", "speed"))
    parser.add_argument("clips", nargs="+", type=Path)
    parser.add_argument("--models", nargs="+", default=["gamesr"])
    parser.add_argument("--kbps", nargs="+", type=int, default=[8000, 4000])
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--crop", type=lambda text: tuple(int(side) for side in text.split("x")), help="WxH of the input, its middle")
    arguments = parser.parse_args()
    upscalers = [OnnxUpscaler(find_model(name, 2), threads=1) for name in arguments.models]
    bicubic = OnnxUpscaler(find_model("bicubic", 2), threads=1)
    for path in arguments.clips:
        with ExitStack() as stack:
            fps = round(stack.enter_context(VideoSource(path)).frame_rate)
        references = list(clip_frames(path, 1, arguments.frames))
        small = [area_downscale(frame, 2) for frame in references]
        height, width = small[0].height, small[0].width
        columns, rows = arguments.crop or (width, height)
        top, left = ((whole - part) // 2 // MACROBLOCK * MACROBLOCK for whole, part in ((height, rows), (width, columns)))
        box, large = Box(top, left, top + rows, left + columns), Box(2 * top, 2 * left, 2 * (top + rows), 2 * (left + columns))
        truths = [cut(frame, large) for frame in references]
        for kbps in arguments.kbps:
            clip = [known.cut(box) if arguments.crop else known for known in decoded(small, CloudSettings(kbps, fps))]
            title = f"{path.stem.removesuffix('_1080p')} {kbps}"
            if arguments.trial == "speed":
                speed_trial(clip)
                continue
            for upscaler in upscalers:
                if arguments.trial == "tiles":
                    tiles_trial(title, clip, truths, upscaler, bicubic)
                elif arguments.trial == "detail":
                    detail_trial(title, clip, truths, upscaler, bicubic)
                else:
                    alignment_trial(title, clip, truths, upscaler, bicubic, WAYS if arguments.trial == "alignment" else CHOICES)


def cut(frame: Frame, box: Box) -> Frame:
    chroma = box.slices(divide=2)
    return replace(frame, y=np.ascontiguousarray(frame.y[box.slices()]), u=frame.u[chroma], v=frame.v[chroma])


if __name__ == "__main__":
    main()
