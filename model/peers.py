"""Published networks that ours is held against, from their papers: FSRCNN, SRVGGNetCompact and IMDN, trained and run as ours are.

Each is as published between what it was published for, luma or RGB in [0, 1], at any scale. Around it, the decoder's planes:
a network of luma leaves chroma to bicubic interpolation; one of RGB gets the colour conversion of our `paper` preset.
None has memory. No base is added to what the authors drew, so FSRCNN and IMDN have to learn the picture itself.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from model.colour import PlanesToRgb, RgbToPlanes
from model.interpolation import Interpolation, chroma_shift, exact
from model.planes import Network, Planes, State


def prelu_layers(*sizes: tuple[int, int, int]) -> nn.Sequential:
    """Convolutions of (inputs, outputs, side), a PReLU after each, initialized to keep the signal's variance (He et al. 2015, eq. 15)."""
    layers: list[nn.Module] = []
    for inputs, outputs, side in sizes:
        conv = nn.Conv2d(inputs, outputs, side, padding=side // 2)
        nn.init.kaiming_normal_(conv.weight, 0.25)  # PReLU's slope at the start
        layers += conv, nn.PReLU(outputs)
    return nn.Sequential(*layers)


class Fsrcnn(nn.Module):
    """FSRCNN(d=56, s=12, m=4) of Dong et al. 2016 (section 3.2, figure 2): luma (N, 1, H, W) to (N, 1, scale*H, scale*W).

    The paper's 12,464 parameters (table 1) are the filters alone, the same at every scale; with 173 biases and 172 slopes
    of PReLU, one a channel, there are 12,809.
    """

    def __init__(self, scale: int) -> None:
        d, s, m = 56, 12, 4
        super().__init__()
        self.body = prelu_layers((1, d, 5), (d, s, 1), *[(s, s, 3)] * m, (s, d, 1))
        # Filters 9 wide about the middle of an output cell, or the pixel before it where a cell has no middle.
        padding = (10 - scale) // 2
        self.deconv = nn.ConvTranspose2d(d, 1, 9, stride=scale, padding=padding, output_padding=scale + 2 * padding - 9)
        nn.init.normal_(self.deconv.weight, std=0.001)

    def forward(self, luma: Tensor) -> Tensor:
        x = self.body(luma)
        with exact(x):  # the picture itself comes out: bfloat16 would round it to half a code value
            picture: Tensor = self.deconv(x.to(self.deconv.weight.dtype))
        return picture


class Srvgg(nn.Module):
    """SRVGGNetCompact of Real-ESRGAN with 64 channels and 16 convolutions in its body: RGB to RGB, (N, 3, scale*H, scale*W).

    It comes with code, not a paper (xinntao/Real-ESRGAN, realesrgan/archs/srvgg_arch.py); `realesr-animevideov3` is this
    at x4. By that definition it has 621,424 parameters at x4, 609,307 at x3 and 600,652 at x2.
    """

    def __init__(self, scale: int, channels: int = 64, convolutions: int = 16) -> None:
        super().__init__()
        self.scale = scale
        # Torch's own initialization, which the code leaves, lets less than a millionth of the picture through 17 layers: a short training
        # would stay at the nearest pixel.
        self.body = prelu_layers((3, channels, 3), *[(channels, channels, 3)] * convolutions)
        self.last = nn.Conv2d(channels, 3 * scale**2, 3, padding=1)

    def forward(self, rgb: Tensor) -> Tensor:
        # the nearest pixel under every pixel of a cell, added before PixelShuffle puts the cell together
        nearest = rgb.unsqueeze(2).expand(-1, -1, self.scale**2, -1, -1).flatten(1, 2)
        return F.pixel_shuffle(self.last(self.body(rgb)) + nearest, self.scale)


class ContrastAttention(nn.Module):
    """Contrast-aware channel attention (IMDN, section 3.3): channels weighted by their mean and deviation over the whole picture."""

    def __init__(self, channels: int, reduction: int = 16) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels, channels // reduction, 1)
        self.excite = nn.Conv2d(channels // reduction, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        with exact(x):
            wide = x.to(self.squeeze.weight.dtype)
            mean = wide.mean((2, 3), keepdim=True)
            variance = (wide - mean).square().mean((2, 3), keepdim=True)
            contrast = (variance + 1e-8).sqrt()  # the paper's root has no slope at zero
            weights = torch.sigmoid(self.excite(F.relu(self.squeeze(contrast + mean))))
        return x * weights.to(x.dtype)


class DistillationBlock(nn.Module):
    """IMDB (IMDN, section 3.2): three times a quarter of the channels is kept and the rest goes on."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.kept = channels // 4
        rest = channels - self.kept
        self.steps = nn.ModuleList(nn.Conv2d(inputs, channels, 3, padding=1) for inputs in (channels, rest, rest))
        self.final = nn.Conv2d(rest, self.kept, 3, padding=1)
        self.attention = ContrastAttention(channels)
        self.fusion = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        kept, rest = [], x
        for step in self.steps:
            done = F.leaky_relu(step(rest), 0.05)
            kept.append(done[:, : self.kept])
            rest = done[:, self.kept :]
        kept.append(self.final(rest))
        fused: Tensor = self.fusion(self.attention(torch.cat(kept, 1)))
        return x + fused


class Imdn(nn.Module):
    """IMDN of Hui et al. 2019 (section 3.1, figure 2): RGB to RGB, (N, 3, scale*H, scale*W).

    694,404 parameters at x2, 703,059 at x3, 715,176 at x4; the paper prints 694K, 703K and 715K.
    """

    def __init__(self, scale: int, channels: int = 64, blocks: int = 6) -> None:
        super().__init__()
        self.scale = scale
        self.stem = nn.Conv2d(3, channels, 3, padding=1)
        self.blocks = nn.ModuleList(DistillationBlock(channels) for _ in range(blocks))
        self.fusion = nn.Conv2d(blocks * channels, channels, 1)
        self.smooth = nn.Conv2d(channels, channels, 3, padding=1)
        self.last = nn.Conv2d(channels, 3 * scale**2, 3, padding=1)

    def forward(self, rgb: Tensor) -> Tensor:
        x = stem = self.stem(rgb)
        outputs = []
        for block in self.blocks:
            x = block(x)
            outputs.append(x)
        x = stem + self.smooth(F.leaky_relu(self.fusion(torch.cat(outputs, 1)), 0.05))
        with exact(x):  # as in FSRCNN
            return F.pixel_shuffle(self.last(x.to(self.last.weight.dtype)), self.scale)


class LumaPeer(Network):
    """A network of luma between the decoder's planes, bicubic interpolation for chroma."""

    def __init__(self, architecture: str, body: Callable[[int], nn.Module], scale: int) -> None:
        super().__init__(scale, 2, {"architecture": architecture, "scale": scale})
        self.body = body(scale)
        self.chroma = Interpolation("bicubic", scale, 1, chroma_shift(scale))

    def step(
        self, frame: Planes, state: State | None, finish: Callable[[Tensor], Tensor] = lambda samples: samples
    ) -> tuple[Planes, State | None]:
        y = finish(255 * self.body(frame.y / 255))
        u, v = (F.pixel_shuffle(finish(self.chroma(plane)), self.scale) for plane in (frame.u, frame.v))
        return Planes(y, u, v), None


class RgbPeer(Network):
    """A network of RGB between the decoder's planes, the colour conversions around it."""

    def __init__(self, architecture: str, body: Callable[[int], nn.Module], scale: int) -> None:
        super().__init__(scale, 2, {"architecture": architecture, "scale": scale})
        self.to_rgb, self.body, self.to_planes = PlanesToRgb(), body(scale), RgbToPlanes()

    def step(
        self, frame: Planes, state: State | None, finish: Callable[[Tensor], Tensor] = lambda samples: samples
    ) -> tuple[Planes, State | None]:
        return Planes(*(finish(plane) for plane in self.to_planes(self.body(self.to_rgb(*frame))))), None


PEERS: dict[str, tuple[type[LumaPeer | RgbPeer], Callable[[int], nn.Module]]] = {
    "fsrcnn": (LumaPeer, Fsrcnn),
    "srvgg": (RgbPeer, Srvgg),
    "imdn": (RgbPeer, Imdn),
}
