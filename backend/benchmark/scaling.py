"""How time and memory grow with views, pixels and the grid: power laws fitted to timed runs."""

import math
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from ..machine import choose_device, peak_memory_bytes, set_up_torch
from ..presets import Settings
from ..stages.surface import Surface
from ..stages.train.surface_fit import TrainConfig
from .one_by_one import extract, fit, match, place
from .suites import Case
from .summary import Column, markdown
from .variants import Variant

LARGEST_LINEAR = 1.1
"""An exponent that may still be linear: over four times the size, 15 % off in time is a tenth."""

_NUM_VIEWS = 6
"""Where their number is not what changes."""


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What is timed once."""

    num_views: int
    """The first of those that the case gives, which are neighbours."""
    settings: Settings


@dataclass(frozen=True, kw_only=True)
class Cost:
    """A run's numbers; the unit is the last word of a name."""

    sizes: Mapping[str, int]
    """By the names of the sweeps: views, pixels of one of them, nodes of the finest grid."""
    numbers: Mapping[str, float | None]


def _balanced(setting: str, value: object) -> Settings:
    return Variant(name=setting, preset="balanced", changes={setting: value}).settings


def _of_views(num_views: int) -> Setup:
    # Each is compared with two others whatever their number, so that the work for one view stays the same.
    return Setup(num_views=num_views, settings=_balanced("stereo.num_sources", 2))


def _of_pixels(max_side_px: int) -> Setup:
    return Setup(num_views=_NUM_VIEWS, settings=_balanced("photos.max_side_px", max_side_px))


def _of_nodes(nodes: int) -> Setup:
    return Setup(
        num_views=_NUM_VIEWS, settings=_balanced("train.levels", (*TrainConfig().levels[:-1], nodes))
    )


SWEEPS = MappingProxyType(
    {
        "views": tuple(map(_of_views, (3, 6, 12))),
        "pixels": tuple(map(_of_pixels, (400, 566, 800))),
        "nodes": tuple(map(_of_nodes, (64, 96, 128, 192))),
    }
)
"""By what changes; all else stays as `balanced` has it."""

COLUMNS = (
    Column(heading="stereo s", number="stereo_s", digits=2),
    Column(heading="field s", number="train_s", digits=2),
    Column(heading="of it the finest grid s", number="finest_grid_s", digits=2),
    Column(heading="mesh s", number="mesh_s", digits=2),
    Column(heading="peak memory GB", number="peak_memory_bytes", digits=2, scale=1e-9),
    Column(heading="of it for the work GB", number="work_memory_bytes", digits=2, scale=1e-9),
)
"""The table's rows. A process holds much before any work: its peak alone hides how the rest grows."""


def measure(case: Case, folder: Path, setup: Setup, device_kind: str) -> Cost:
    """The stages after the cameras, run once in this process. It must be a new one: it knows only one peak.

    Raises ReconstructionError.
    """
    held = peak_memory_bytes()
    device = choose_device(device_kind)
    set_up_torch(device)
    settings = setup.settings
    placed = place(case, folder, case.given[: setup.num_views], settings)
    fitted_at_s: list[float] = []

    def note_time(_surface: Surface) -> None:
        fitted_at_s.append(time.perf_counter())

    stereo, stereo_took = match(placed, settings, device)
    surface, train_took = fit(placed, stereo, settings, seed=0, device=device, show=note_time)
    _, mesh_took = extract(placed, stereo, surface, settings)
    peak = peak_memory_bytes()
    camera = placed.views[0].camera
    return Cost(
        sizes={
            "views": len(placed.views),
            "pixels": camera.width * camera.height,
            "nodes": surface.distance.size,
        },
        numbers={
            "stereo_s": stereo_took.wall,
            "train_s": train_took.wall,
            "finest_grid_s": fitted_at_s[-1] - fitted_at_s[-2],
            "mesh_s": mesh_took.wall,
            "peak_memory_bytes": peak,
            "work_memory_bytes": None if peak is None or held is None else peak - held,
        },
    )


def least(costs: Sequence[Cost]) -> Cost:
    """The smallest of each number over runs of one setup: whatever else the machine does only adds."""
    numbers = {name: [cost.numbers[name] for cost in costs] for name in costs[0].numbers}
    known = {name: [value for value in values if value is not None] for name, values in numbers.items()}
    return Cost(
        sizes=costs[0].sizes,
        numbers={name: min(values) if values else None for name, values in known.items()},
    )


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """p of the power law value = c size^p: the slope of the least-squares line through the logarithms.

    Needs two sizes that differ; all numbers must be above 0.
    """
    return statistics.linear_regression([*map(math.log, sizes)], [*map(math.log, values)]).slope


def exponents(sweep: str, costs: Sequence[Cost]) -> dict[str, float]:
    """By the name of the number; without those that are not known, or not above 0, in every run."""
    sizes = [cost.sizes[sweep] for cost in costs]
    found = {}
    for column in COLUMNS:
        values = [cost.numbers[column.number] or 0.0 for cost in costs]
        if len(set(sizes)) > 1 and min(values) > 0:
            found[column.number] = exponent(sizes, values)
    return found


def table(sweep: str, costs: Sequence[Cost]) -> str:
    """Markdown: a row for each number, a column for each size, and last the exponent."""
    known = exponents(sweep, costs)
    rows = []
    for column in COLUMNS:
        values = [cost.numbers[column.number] for cost in costs]
        if any(value is not None for value in values):
            cells = ["-" if v is None else f"{v * column.scale:.{column.digits}f}" for v in values]
            last = f"{known[column.number]:.2f}" if column.number in known else "-"
            rows.append([column.heading, *cells, last])
    return markdown([sweep, *(f"{cost.sizes[sweep]:,}" for cost in costs), "exponent"], rows)


def verdict(sweep: str, costs: Sequence[Cost]) -> str:
    """A line that says what grows faster than linearly."""
    known = exponents(sweep, costs)
    worse = [
        f"{column.heading} ({known[column.number]:.2f})"
        for column in COLUMNS
        if known.get(column.number, 0.0) > LARGEST_LINEAR
    ]
    return f"Worse than linear in {sweep}: {', '.join(worse) or 'nothing'}.\n"
