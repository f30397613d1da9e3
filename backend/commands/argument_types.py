"""Types of arguments that several commands take; standard library only."""

import argparse
import math

from ..wire.protocol import LARGEST_SEED


def seed(text: str) -> int:
    """A seed of the command line; ValueError or ArgumentTypeError where it is none."""
    number = int(text)
    if not 0 <= number <= LARGEST_SEED:
        raise argparse.ArgumentTypeError(f"must be from 0 to {LARGEST_SEED}")
    return number


def finite_number(text: str) -> float:
    """A number of the command line; ValueError or ArgumentTypeError where it is none or not finite."""
    number = float(text)
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError("must be a finite number")
    return number


def positive_seconds(text: str) -> float:
    """A budget of the command line; ValueError or ArgumentTypeError where it is none."""
    seconds = float(text)
    if not 0 < seconds < math.inf:
        raise argparse.ArgumentTypeError("must be a positive number")
    return seconds


def count(text: str) -> int:
    """How often, on the command line; ValueError or ArgumentTypeError below 1."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return number
