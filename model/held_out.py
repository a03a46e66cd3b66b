"""What a network gains over bicubic interpolation on held-out scenes, while it is trained."""

from __future__ import annotations

import numpy as np
import torch

from client.quality import psnr_db
from model.catalogue import described_network
from model.footage import Pair
from model.planes import Network, to_planes


@torch.no_grad()
def psnr_y_beside_bicubic(network: Network, pair: Pair, frames: int) -> dict[str, float | None]:
    """PSNR-Y in dB from the mean MSE of rounded luma over the first frames, for the network and for bicubic interpolation.

    None where the pictures are identical, which have no PSNR.
    """
    device = network.weight.device
    bicubic = described_network({"scale": network.scale, "blocks": 0, "recurrent": False}).to(device)  # untrained, it is that
    low, high = ([plane[:frames, None, None] for plane in take.planes()] for take in (pair.low, pair.high))
    state = network.initial_state(1, pair.low.height, pair.low.width)
    errors = np.zeros(2)
    count = min(frames, len(pair))
    for t in range(count):
        frame, target = to_planes([p[t] for p in low], device), torch.from_numpy(high[0][t]).to(device, torch.float32)
        ours, state = network.step(frame, state)
        base, _ = bicubic.step(frame, None)
        errors += [float((picture.y.round().clamp(0, 255) - target).square().mean()) for picture in (ours, base)]
    ours_db, bicubic_db = (psnr_db(error / count) if error else None for error in errors.tolist())
    return {"psnr_y_db": ours_db, "bicubic_db": bicubic_db}


def gain_db(row: dict[str, float | None]) -> float | None:
    """By how much the network is nearer than bicubic interpolation; None where that is not defined."""
    ours, bicubic = row["psnr_y_db"], row["bicubic_db"]
    return None if ours is None or bicubic is None else ours - bicubic
