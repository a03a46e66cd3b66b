"""What decides a figure beside its inputs: the programs that encode, decode, upscale and measure."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

import av
import onnxruntime

from client.vmaf import MODELS, why_unavailable

_QUALITY_VERSION = "2"  # of the definitions in client.quality and client.vmaf: raise it when a figure changes


def versions(width: int, height: int) -> dict[str, str]:
    """By name, for pictures measured at this size: PyAV brings encoder and decoder, the wheel of ffmpeg brings VMAF."""
    missing = why_unavailable(width, height)
    return {
        "av": av.__version__,
        "onnxruntime": onnxruntime.__version__,
        "quality": _QUALITY_VERSION,
        "vmaf": f"{', '.join(MODELS.values())}, imageio-ffmpeg {_version('imageio-ffmpeg')}" if missing is None else missing,
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
