"""The picture of speed against error. Needs matplotlib, which only developers have."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from .summary import Summary, pareto_front

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

_MARKERS = "os^Dv*"
_TICKS = (1, 2, 3, 4, 5, 6, 8)
"""In every power of ten."""
_ROWS_OF_LEGEND = 24
_STYLE: dict[Any, Any] = {"svg.hashsalt": "fewview", "svg.fonttype": "none", "font.size": 9}
"""The same numbers give the same bytes."""


def colour_difference_percent(psnr_db: float) -> float:
    """The root mean square difference of colours that a PSNR stands for, in percent of full brightness."""
    return float(100 * 10 ** (-psnr_db / 20))


def draw(path: Path, summaries: Sequence[Summary]) -> None:
    """Write an SVG: error, and difference from held-out views, against seconds after the cameras are known.

    A colour for each case, a marker for each preset. Filled and joined is the Pareto front of a case; hollow
    is what a preset of the same case beats in both. Small and dashed are a preset's runs with a budget,
    in order of time; they take no part in the front. On several devices a preset counts as several.
    """
    if len({summary.device for summary in summaries}) > 1:
        summaries = [replace(s, preset=f"{s.preset} on {s.device}") for s in summaries]
    with matplotlib.rc_context(_STYLE):
        num_names = len({(summary.case, summary.preset, summary.budget_s is None) for summary in summaries})
        num_columns = max(1, math.ceil(num_names / _ROWS_OF_LEGEND))
        figure = Figure(figsize=(9 + 2 * num_columns, 5), layout="constrained")
        left, right = figure.subplots(1, 2)
        _panel(left, summaries, "visible_chamfer_percent")
        left.set_ylabel("Chamfer distance of the visible part, % of the diagonal")
        _panel(right, summaries, "held_out_psnr_db")
        right.set_ylabel("difference from held-out views, % RMS")
        known = _legend(left) | _legend(right)
        figure.legend(known.values(), known.keys(), loc="outside right upper", ncols=num_columns)
        figure.savefig(path, format="svg", metadata={"Date": None})


def points_of(summaries: Sequence[Summary], number: str) -> tuple[tuple[Summary, tuple[float, float]], ...]:
    """The summaries that have the number, each with its seconds and its error; less is better in both."""
    found = []
    for summary in summaries:
        seconds, value = summary.median.get("after_cameras_s"), summary.median.get(number)
        if seconds is not None and value is not None:
            error = colour_difference_percent(value) if number.endswith("_psnr_db") else value
            found.append((summary, (seconds, error)))
    return tuple(found)


def budget_curve(
    points: Sequence[tuple[Summary, tuple[float, float]]],
) -> tuple[tuple[float, float], ...]:
    """The points of those that had a budget, in order of time."""
    return tuple(sorted(point for summary, point in points if summary.budget_s is not None))


def _legend(axes: "Axes") -> dict[str, "Artist"]:
    """Label to what it stands for."""
    handles, labels = axes.get_legend_handles_labels()
    return dict(zip(labels, handles, strict=True))


def _marker(presets: Sequence[str], preset: str) -> str:
    return _MARKERS[presets.index(preset) % len(_MARKERS)]


def _panel(axes: "Axes", summaries: Sequence[Summary], number: str) -> None:
    points = points_of(summaries, number)
    presets = list(dict.fromkeys(summary.preset for summary in summaries))
    for index, case in enumerate(dict.fromkeys(summary.case for summary in summaries)):
        mine = [(summary, point) for summary, point in points if summary.case == case]
        of_case = [(summary.preset, point) for summary, point in mine if summary.budget_s is None]
        front = pareto_front([point for _, point in of_case])
        colour = f"C{index % 10}"
        line = [of_case[place][1] for place in front]
        axes.plot([x for x, _ in line], [y for _, y in line], color=colour, linewidth=1)
        for place, (preset, (x, y)) in enumerate(of_case):
            axes.plot(
                [x],
                [y],
                color=colour,
                marker=_marker(presets, preset),
                markerfacecolor=colour if place in front else "white",
                linestyle="none",
                label=f"{case}, {preset}",
            )
        for preset in presets:
            curve = budget_curve([pair for pair in mine if pair[0].preset == preset])
            if curve:
                seconds, errors = zip(*curve, strict=True)
                axes.plot(
                    seconds,
                    errors,
                    color=colour,
                    marker=_marker(presets, preset),
                    markersize=3,
                    linestyle="--",
                    linewidth=0.8,
                    label=f"{case}, {preset}, budgets",
                )
    if points:
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):  # 0.5 and 20 rather than powers of ten
            axis.set_major_locator(LogLocator(subs=_TICKS))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("seconds after the cameras are known")
    axes.grid(visible=True, which="both", linewidth=0.3)
