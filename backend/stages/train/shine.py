"""Whether a thing shines, and what of it photographs show: light that depends on the mirrored direction.

Fitted to what photographs show differently where patches are silent, and believed if that predicts what they
show differently where patches agree. A matt thing is left as it is.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from ...maths.brightness import median_deviation
from ...maths.mirrored_light import MirroredLight, gain_nats, mirrored_light, spread_of_bins
from ...maths.rows import Rows

_LEAST_GAIN_NATS = 0.06
"""Of a prediction, for each box: an eighth of the variance. Matt things have up to 0.05 in most looks,
painted ones that shine a little 0.04 to 0.24 (docs/experiments.md)."""
_LEAST_DIFFERENCE = 0.001
"""Between photographs, in linear light: a third of eight bits' step."""
_OFF_CELLS = 1.0
"""About what a field is off where patches are silent."""


@dataclass(frozen=True, kw_only=True)
class Boxes(Rows):
    """What two photographs show differently, by channels, averaged over boxes of places."""

    difference: Float[Tensor, "boxes channels"]
    slope: Float[Tensor, "boxes channels"]
    """Its change per unit along the rays of one of them."""
    mirrored: Float[Tensor, "boxes bins"]
    """Mirrored directions, as in maths.mirrored_light.means_of_bins."""
    sure: Bool[Tensor, "boxes"]
    """Whether patches agree there."""


@dataclass(frozen=True, kw_only=True)
class Shine:
    """Mirrored light by channels, and what it leaves over."""

    lights: tuple[MirroredLight, ...]
    variance: Float[Tensor, "channels bins"]
    """Of what is left over, by direction."""

    def taken_off(
        self, difference: Float[Tensor, "channels *places"], bins: Int64[Tensor, "2 *places"]
    ) -> tuple[Float[Tensor, "channels *places"], Float[Tensor, "channels *places"]]:
        """What else differs between two photographs, and its standard deviation; `bins` are those of both."""
        here, there = bins
        mirrored = torch.stack([light.difference(here, there) for light in self.lights])
        known = torch.stack([light.variance(here, there) for light in self.lights])
        left = (self.variance[:, here] + self.variance[:, there]) / 2
        return difference - mirrored, (known + left).sqrt()


def deviations(difference: Float[Tensor, "boxes channels"]) -> Float[Tensor, "channels"]:
    """By how much boxes differ, from their median and thus without the few that something else spoils."""
    return median_deviation(difference.T).clamp(min=_LEAST_DIFFERENCE)


def mirrored_by(boxes: Boxes, matt_noise: Float[Tensor, "channels"], cell: float) -> Shine | None:
    """Mirrored light, of boxes some of which are sure; None of a thing that is matt.

    `matt_noise` are the deviations of the sure ones, and `cell` is the side of a cell of the grid.
    """
    device, sure = boxes.sure.device, boxes.sure.cpu()
    rows, difference, slope, noise = (
        values.cpu().double() for values in (boxes.mirrored, boxes.difference.T, boxes.slope.T, matt_noise)
    )
    off2 = torch.where(sure, 0.0, _OFF_CELLS * cell * slope).square()
    variance = noise[:, None].square() + off2

    def fitted(channel: int, which: Bool[Tensor, "boxes"]) -> MirroredLight:
        at = (channel, which)
        return mirrored_light(rows[which], difference[at], variance[at], float(noise[channel]))

    brightness = fitted(0, ~sure)
    if gain_nats(brightness, rows[sure], difference[0, sure], variance[0, sure]) < _LEAST_GAIN_NATS:
        return None
    lights = [fitted(channel, torch.ones_like(sure)) for channel in range(len(noise))]
    left = difference - torch.stack([rows @ light.mean for light in lights])
    left2 = deviations(left[:, sure].T).square()[:, None]
    spread = torch.stack(
        [spread_of_bins(rows, one.square() / (left2[c] + off2[c])) for c, one in enumerate(left)]
    )
    return Shine(
        lights=tuple(light.to(device) for light in lights), variance=(left2 * spread).float().to(device)
    )
