"""How large the weights of an int8 artifact may be, so that it is computed right on every processor.

Without VNNI (AVX2 alone, AVX512 before Cascade Lake) x86 adds two products of 8 bits up in 16 bits and cuts off what is larger, in OpenVINO
too: with weights up to 127 bright areas come out up to 51 codes wrong there, and right elsewhere. Twice 255 x 64 fits.
"""

from __future__ import annotations

from typing import Any

MOST = 64


def sums_fit(model: Any) -> bool:
    """Whether no constant of 8 bits in one of OpenVINO's models is beyond MOST, on either side."""
    codes = [operation.data for operation in model.get_ops() if operation.get_type_name() == "Constant"]
    return all(data.min() >= -MOST and data.max() <= MOST for data in codes if data.dtype == "int8" and data.size)
