"""Compiled work on several cores: threads of Python, whose lock compiled code lets go."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


def side_by_side(work: Callable[[Task], Result], tasks: Iterable[Task], threads: int) -> list[Result]:
    """Of each task, in their order."""
    if threads == 1:
        return [work(task) for task in tasks]
    return list(_pool(threads).map(work, tasks))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads that stay: starting them takes longer than many a task."""
    return ThreadPoolExecutor(threads, thread_name_prefix="compiled")
