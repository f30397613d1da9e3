"""Types of arguments that several commands take; standard library only."""

import argparse

from ..wire.protocol import LARGEST_SEED


def seed(text: str) -> int:
    """A seed of the command line; ValueError or ArgumentTypeError where it is none."""
    number = int(text)
    if not 0 <= number <= LARGEST_SEED:
        raise argparse.ArgumentTypeError(f"must be from 0 to {LARGEST_SEED}")
    return number
