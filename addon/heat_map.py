"""Numbers as colours: where a mesh is measured and where it is guessed, and how far it is off.

The same colours as in the report page, which has them in `backend/report_page/pictures.py`. Both ramps
change their lightness all along, so that they can be told apart without seeing red from green. No Blender
needed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class HeatMap:
    """How a float attribute is shown."""

    attribute: str
    colours: str
    """Name of the colour attribute that shows it."""
    stops_srgb: tuple[tuple[int, int, int], ...]
    """Evenly spaced from 0 to the limit."""
    limit: float
    """What is larger is shown like this."""
    legend: str


SUPPORT = HeatMap(
    attribute="support",
    colours="Support Map",
    stops_srgb=((201, 84, 29), (240, 196, 106), (94, 178, 168), (15, 106, 122)),
    limit=1.0,
    legend="Red is guessed, yellow is seen by few photographs, blue green is measured",
)
ERROR = HeatMap(
    attribute="error",
    colours="Error Map",
    stops_srgb=((245, 241, 232), (252, 196, 110), (226, 88, 52), (110, 9, 30)),
    limit=2.0,
    legend="White lies on the original, yellow to dark red is off, by 2 % of its size and more",
)


def heat_colours(heat: HeatMap, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(values, 4): sRGB and alpha from 0 to 1, interpolated linearly between the stops."""
    stops = np.array(heat.stops_srgb, np.float64) / 255
    places = np.linspace(0.0, heat.limit, len(stops))
    known = np.nan_to_num(values, nan=heat.limit)
    colours = np.ones((len(values), 4), np.float32)
    for channel in range(3):
        colours[:, channel] = np.interp(known, places, stops[:, channel])
    return colours
