"""What the measurements of chosen cases have in common: where cases lie, where results go."""

import argparse
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from backend.benchmark.suites import Case, Suite, find_cases
from backend.waiting import set_waiting_policy
from backend.wire.protocol import DEVICES

T = TypeVar("T")


def add_places(parser: argparse.ArgumentParser) -> None:
    """The words that name folders and the device."""
    add = parser.add_argument
    add("--scenes", metavar="DIR", type=Path, help="rendered scenes")
    add("--photos", metavar="DIR", type=Path, help="sets of real photographs")
    add("--output", metavar="DIR", type=Path, required=True)
    add("--device", choices=DEVICES, default="auto", help="where to compute (auto)")


def chosen_cases(
    parser: argparse.ArgumentParser, parsed: argparse.Namespace, cases: Sequence[Case]
) -> tuple[tuple[Case, Path], ...]:
    """The cases with their folders; ends the program where files of one are missing."""
    found = find_cases(Suite(name="chosen", cases=tuple(cases)), parsed.scenes, parsed.photos)
    if found.missing:
        parser.error(f"files are missing of {', '.join(found.missing)}")
    return found.cases


def alone(work: Callable[..., T], *arguments: Any) -> T:
    """The result from a new process, which holds nothing of this one; its threads wait as those of a run."""
    set_waiting_policy()
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()
