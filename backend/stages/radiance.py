"""A field of density and radiance as a record, as it is kept and written to a file."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64


@dataclass(frozen=True, kw_only=True)
class RadianceShape:
    """Sizes of the networks, and how often they are asked."""

    width: int = 64
    layers: int = 4
    """Hidden layers between place and density."""
    frequencies: int = 8
    """Of the encoded place; the finest wave is 2^(2 - frequencies) object units long."""
    direction_frequencies: int = 2
    proposal_width: int = 32
    proposal_frequencies: int = 5
    proposal_intervals: int = 32
    """On each ray."""
    intervals: int = 16
    """On each ray."""


@dataclass(frozen=True, kw_only=True)
class Radiance:
    """A fitted field as data: `published/radiance_field` makes and restores it."""

    shape: RadianceShape
    parameters: Float32[np.ndarray, "parameters"]
    """Of the networks, in the order of RadianceField.parameters()."""
    object_from_world: Float64[np.ndarray, "4 4"]
    """Of the region in which it was fitted."""
    background_srgb: Float32[np.ndarray, "3"] | None
    """Behind the region; None where there is nothing, since masks cut the subject out."""
