"""From measured runs to medians, the Pareto front and a table: pure functions."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from .measuring import Measurement
from .suites import with_budget


@dataclass(frozen=True, kw_only=True)
class Summary:
    """A case with a preset and a budget on a device, over its seeds; numbers that no run has are missing."""

    case: str
    preset: str
    budget_s: float | None
    device: str
    num_runs: int
    """Those that gave a mesh."""
    failures: tuple[str, ...]
    median: Mapping[str, float]
    lowest: Mapping[str, float]
    highest: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class Column:
    """A number as the table shows it."""

    heading: str
    number: str
    digits: int = 0
    scale: float = 1.0
    is_choice: bool = False
    """Whether 1 is yes and 0 no; yes is said where all runs say so."""


COST_COLUMNS = (
    Column(heading="cameras s", number="cameras_s", digits=1),
    Column(heading="stereo s", number="stereo_s", digits=1),
    Column(heading="field s", number="train_s", digits=1),
    Column(heading="mesh s", number="mesh_s", digits=1),
    Column(heading="all s", number="wall_s", digits=1),
    Column(heading="memory GB", number="peak_memory_bytes", digits=2, scale=1e-9),
    Column(heading="PSNR given dB", number="given_psnr_db", digits=1),
    Column(heading="held out dB", number="held_out_psnr_db", digits=1),
)


def error_columns(part: str) -> tuple[Column, ...]:
    """The errors of the "visible" or the "whole" surface, and of the whole what else is asked of it."""
    columns = (
        Column(heading="Chamfer %", number=f"{part}_chamfer_percent", digits=3),
        Column(heading="accuracy %", number=f"{part}_accuracy_percent", digits=3),
        Column(heading="completeness %", number=f"{part}_completeness_percent", digits=3),
        Column(heading="F@0.5%", number=f"{part}_f_score_at_half_percent", digits=3),
        Column(heading="F@1%", number=f"{part}_f_score_at_one_percent", digits=3),
        Column(heading="normals", number=f"{part}_normal_consistency", digits=3),
    )
    of_whole = (
        Column(heading="support AUC", number="support_auc", digits=3),
        Column(heading="closed", number="watertight", is_choice=True),
    )
    return (*columns, *of_whole) if part == "whole" else columns


def aggregate(runs: Sequence[Measurement]) -> tuple[Summary, ...]:
    """One summary for each case, preset, budget and device, in the order in which they first appear."""
    groups: dict[tuple[str, str, float | None, str], list[Measurement]] = {}
    for run in runs:
        groups.setdefault((run.case, run.preset, run.budget_s, run.device), []).append(run)
    return tuple(_summary(group) for group in groups.values())


def _summary(runs: Sequence[Measurement]) -> Summary:
    """Of runs that differ in their seed alone."""
    known: dict[str, list[float]] = {}
    for run in runs:
        for name, value in run.numbers.items():
            if value is not None:
                known.setdefault(name, []).append(value)
    return Summary(
        case=runs[0].case,
        preset=runs[0].preset,
        budget_s=runs[0].budget_s,
        device=runs[0].device,
        num_runs=sum(bool(run.numbers) for run in runs),
        failures=tuple(run.failure for run in runs if run.failure is not None),
        median={name: statistics.median(values) for name, values in known.items()},
        lowest={name: min(values) for name, values in known.items()},
        highest={name: max(values) for name, values in known.items()},
    )


def pareto_front(points: Sequence[tuple[float, float]]) -> tuple[int, ...]:
    """Indices of the points that no other one dominates, by their first number; less is better in both.

    A point dominates another if it is worse in neither number and better in one.
    """
    front = [
        index for index, point in enumerate(points) if not any(_dominates(other, point) for other in points)
    ]
    return tuple(sorted(front, key=lambda index: points[index]))


def _dominates(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one[0] <= other[0] and one[1] <= other[1] and one != other


def table(summaries: Sequence[Summary], columns: Sequence[Column], *, compared: str = "preset") -> str:
    """A Markdown table with a row for each summary: the median, and after ± half the range over the seeds.

    `compared` is the heading of what runs of a case differ in; several devices have a column of their own.
    """
    several = len({summary.device for summary in summaries}) > 1
    headings = ["case", compared, *(["device"] * several), *(column.heading for column in columns)]
    rows = [
        [
            summary.case,
            with_budget(summary.preset, summary.budget_s),
            *([summary.device] * several),
            *(_cell(summary, column) for column in columns),
        ]
        for summary in summaries
    ]
    return markdown(headings, rows)


def markdown(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    return "\n".join([_row(headings), "|" + "---|" * len(headings), *map(_row, rows)]) + "\n"


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _cell(summary: Summary, column: Column) -> str:
    if not summary.num_runs:
        return "failed"
    median = summary.median.get(column.number)
    if median is None:
        return "-"
    lowest, highest = summary.lowest[column.number], summary.highest[column.number]
    if column.is_choice:
        return "yes" if lowest == 1 else "no"
    text = f"{median * column.scale:.{column.digits}f}"
    if summary.num_runs == 1:
        return text
    return f"{text} ± {(highest - lowest) / 2 * column.scale:.{column.digits}f}"
