"""What a player takes where nobody chose: the runtime and the models that were the fastest of their quality on a processor of that kind."""

from __future__ import annotations

from client.cores import has_amx
from client.runtime import OPENVINO, computes_in, is_installed

AUTO = "auto"
FLOAT_TIERS = ("quality", "balanced", "live", "fast", "bicubic")
INT8_TIERS = ("quality", "balanced-int8", "live-int8", "fast-int8", "bicubic")


def chosen_provider() -> str:
    """OpenVINO where it is installed, in bfloat16 where the processor has it; else ONNX Runtime. No GPU unless it is asked for."""
    if not is_installed("openvino"):
        return "cpu"
    return "openvino-bfloat16" if computes_in("openvino-bfloat16") else "openvino"


def chosen_tiers(provider: str) -> list[str]:
    """Models to move between, the best first, for one of PROVIDERS.

    8 bits are the fast ones in OpenVINO on processors without AMX.
    """
    return list(INT8_TIERS if provider in OPENVINO and not has_amx() else FLOAT_TIERS)
