"""Settings that are changed for a while; no Blender needed."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

Change = tuple[Any, str, Any]
"""Owner, name of its attribute, and the value for the while; skipped where there is no such attribute."""


@contextmanager
def changed(changes: Sequence[Change]) -> Iterator[None]:
    """Make the changes, and take them back at the end, whatever happened meanwhile.

    Changes are taken back in the order in which they are made: one may decide what values another can have.
    For the same reason all values are read before the first is changed.
    """
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in changes if hasattr(owner, name)]
    with ExitStack() as restore:
        for owner, name, value in reversed(before):
            restore.callback(setattr, owner, name, value)
        for owner, name, value in changes:
            if hasattr(owner, name):
                setattr(owner, name, value)
        yield
