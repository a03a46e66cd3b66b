"""LPIPS by an ONNX file of the user's: its weights are in no package, so whoever has them brings them."""

from __future__ import annotations

import hashlib
import math
import stat
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from client.artifact import session_options
from client.errors import ModelError
from client.frames import Frame
from client.rgb import to_rgb

EVERY = 10  # a backbone over a whole 1080p picture takes about as long as everything else of a frame together
MAX_FILE_BYTES = 2**30


class Lpips:
    """Distance of two pictures, R. Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018.

    The file has two inputs, reference and measured picture, float32 (1, 3, H, W) of RGB in -1..1, and one output of one
    number. Frames 0, 10, 20 and so on are compared; the clip's figure is their mean. `version` names the file by its sha256,
    and the frames. Raises ModelError, in one sentence, for a file that is not of this kind.
    """

    def __init__(self, path: Path, *, threads: int) -> None:
        self._path = path
        content = _read(path)
        self.version = f"{hashlib.sha256(content).hexdigest()}, every {EVERY}th frame"
        try:
            self._session = ort.InferenceSession(content, session_options(threads), providers=["CPUExecutionProvider"])
        except Exception as error:  # the runtime's exceptions have no common base
            raise ModelError(f"{path} is not a readable ONNX model of LPIPS, all in one file") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if [tensor.type for tensor in inputs] != ["tensor(float)"] * 2 or len(outputs) != 1:
            raise ModelError(f"{path} is not LPIPS: it must take two float32 pictures (1, 3, H, W) and give one number")
        self._names = [tensor.name for tensor in inputs]
        self._distances: list[float] = []

    def add(self, index: int, reference: Frame, measured: Frame) -> None:
        """Compare one pair of frames if its number is due; nothing of them is kept. Raises what `distance` raises."""
        if index % EVERY == 0:
            self._distances.append(self.distance(reference, measured))

    def distance(self, reference: Frame, measured: Frame) -> float:
        """Of two pictures of one size; raises ModelError where the file does not fit."""
        pictures = dict(zip(self._names, (_network_input(reference), _network_input(measured)), strict=True))
        try:
            (output,) = self._session.run(None, pictures)
        except Exception as error:  # the runtime's exceptions have no common base
            size = f"{reference.width}x{reference.height}"
            raise ModelError(f"{self._path} failed on pictures of {size}: it must take (1, 3, H, W) of any size") from error
        if not isinstance(output, np.ndarray) or output.size != 1 or output.dtype.kind != "f":
            raise ModelError(f"{self._path} is not LPIPS: it must give one number for two pictures")
        return float(output.item())

    def result(self) -> float | None:
        """The mean over the frames that were compared; None where one of them gave no finite number."""
        mean = math.fsum(self._distances) / len(self._distances) if self._distances else math.nan
        return mean if math.isfinite(mean) else None


def _network_input(frame: Frame) -> NDArray[np.float32]:
    """(1, 3, H, W), -1 for black and 1 for white."""
    picture = to_rgb(frame).transpose(2, 0, 1)[None].astype(np.float32)
    return picture / np.float32(127.5) - np.float32(1)


def _read(path: Path) -> bytes:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):  # of which nobody knows how much will come
            raise ModelError(f"LPIPS model {path} is not a file")
        if status.st_size > MAX_FILE_BYTES:
            raise ModelError(f"{path} is larger than {MAX_FILE_BYTES // 2**20} MiB: it is not LPIPS")
        return path.read_bytes()
    except OSError as error:
        raise ModelError(f"LPIPS model {path} cannot be read: {error.strerror}") from error
