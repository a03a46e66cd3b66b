"""What a player takes where nobody chose."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import pytest

from client import choice, cores
from client.choice import FLOAT_TIERS, INT8_TIERS, chosen_provider, chosen_tiers
from client.models import find_model
from client.runtime import PROVIDERS, computes_in


@pytest.mark.parametrize(
    ("told", "amx"),
    [
        ("model name\t: A\nflags\t\t: fpu amx_bf16 avx512_fp16 amx_tile amx_int8\n", True),
        ("model name\t: A\nflags\t\t: fpu avx512_bf16 avx512_vnni\n", False),
        ("model name\t: A\nflags\t\t: fpu amx_tile\nmodel name: amx_bf16 amx_int8\n", False),
        ("processor: 0\n", False),
        (None, False),
    ],
)
def test_amx_is_what_the_system_tells_of(told: str | None, amx: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cores, "CPUINFO", tmp_path / "cpuinfo")
    if told is not None:
        cores.CPUINFO.write_text(told)
    assert cores.has_amx() == amx
    assert cores.machine_name() == "A" or "model name" not in (told or "")
    for provider in PROVIDERS:
        assert chosen_tiers(provider) == list(INT8_TIERS if provider.startswith("openvino") and not amx else FLOAT_TIERS)


def test_the_runtime_is_the_best_that_is_there() -> None:
    assert chosen_provider() == ("openvino-bfloat16" if computes_in("openvino-bfloat16") else "openvino")
    with mock.patch.object(choice, "computes_in", return_value=False):
        assert chosen_provider() == "openvino"
    with mock.patch.object(choice, "is_installed", return_value=False):
        assert chosen_provider() == "cpu"


@pytest.mark.parametrize("scale", [2, 3])
def test_every_tier_ships(scale: int) -> None:
    for name in {*FLOAT_TIERS, *INT8_TIERS}:
        assert find_model(name, scale).is_file()
