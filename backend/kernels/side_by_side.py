"""Compiled work on several cores: threads of Python, whose lock compiled code lets go."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

BAND = 64
"""Rows that a thread works on in one go."""

Task = TypeVar("Task")
Result = TypeVar("Result")


def side_by_side(work: Callable[[Task], Result], tasks: Iterable[Task], threads: int) -> list[Result]:
    """Of each task, in their order."""
    if threads == 1:
        return [work(task) for task in tasks]
    return list(_pool(threads).map(work, tasks))


def bands_side_by_side(
    work: Callable[[tuple[int, int]], None], rows: int, threads: int, *, band: int = BAND
) -> None:
    """Of rows, given as (first, one past the last), together all of them."""
    side_by_side(work, [(top, min(top + band, rows)) for top in range(0, rows, band)], threads)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads that stay: starting them takes longer than many a task."""
    return ThreadPoolExecutor(threads, thread_name_prefix="compiled")
