"""A run as a person sees it: a bar for each stage on a terminal, plain lines anywhere else."""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from .commands.cancelling import CancelRequest
from .errors import ReconstructionError
from .workspace import StageCost

if TYPE_CHECKING:
    from .pipeline import Outcome

_PLAIN_INTERVAL_S = 10.0


class TerminalListener:
    """Shows stages and progress on stderr; results on stdout."""

    def __init__(self, request: CancelRequest, console: Console, bars: Progress | None) -> None:
        self._request = request
        self._console = console
        self._bars = bars
        self._bar = TaskID(0)
        self._title = ""
        self._last_line_s = 0.0

    def resumed(self, stages: tuple[str, ...]) -> None:
        """Say which stages need not be done again."""
        verb = "is" if len(stages) == 1 else "are"
        self._say(f"Resuming: {', '.join(stages)} {verb} done")

    def stage_started(self, name: str, index: int, count: int) -> None:
        """Open the stage's bar."""
        self._title = f"[{index}/{count}] {name}"
        self._last_line_s = time.monotonic()
        if self._bars is not None:
            self._bar = self._bars.add_task(escape(self._title), total=1.0, text="")

    def progressed(self, fraction: float, text: str) -> None:
        """Move the bar; raises Cancelled if the user asked to stop."""
        self._request.check()
        if self._bars is not None:
            self._bars.update(self._bar, completed=fraction, text=escape(text))
        elif time.monotonic() - self._last_line_s > _PLAIN_INTERVAL_S:
            self._last_line_s = time.monotonic()
            self._say(f"{self._title} {fraction:.0%} {text}".rstrip())

    def stage_finished(self, cost: StageCost) -> None:
        """Fill the bar, or say that the stage is done."""
        if self._bars is not None:
            self._bars.update(self._bar, completed=1.0, text=f"{cost.seconds:.1f} s")
        else:
            self._say(f"{self._title} done in {cost.seconds:.1f} s")

    def previewed(self, path: Path) -> None:
        """Nothing: a terminal shows no meshes."""

    def warned(self, text: str) -> None:
        """Show the warning above the bars."""
        self._say(f"Warning: {text}")

    def stopping(self) -> None:
        """Acknowledge the first Ctrl-C."""
        self._say("Stopping at the next step (press Ctrl-C again to end at once) ...")

    def finished(self, output: Path, outcome: "Outcome") -> None:
        """Say where the results are and what they are worth."""
        self._stop_bars()
        lines = [*outcome.summary, *(str(output / name) for name in outcome.files)]
        try:
            sys.stdout.write("".join(f"{line}\n" for line in lines))
            sys.stdout.flush()
        except BrokenPipeError:
            # Who read it has seen enough. Python would try once more at its end, and fail.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

    def failed(self, error: ReconstructionError) -> None:
        """Say what went wrong and what to do."""
        self._stop_bars()
        self._say(f"Error: {error.text}\n{error.remedy}")

    def cancelled(self) -> None:
        """Say how to go on."""
        self._stop_bars()
        self._say("Stopped. Finished stages are kept: run the same command again to resume.")

    def _stop_bars(self) -> None:
        if self._bars is not None:
            self._bars.stop()

    def _say(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def terminal_listener(request: CancelRequest) -> Iterator[TerminalListener]:
    """A listener on stderr, with bars where that is a terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield TerminalListener(request, console, None)
        return
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[text]}"),
    )
    with Progress(*columns, console=console) as bars:
        yield TerminalListener(request, console, bars)
