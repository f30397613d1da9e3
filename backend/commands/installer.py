"""What the steps of an installation share: running programs, and telling of it. Standard library only."""

import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ..wire import protocol
from ..wire.speaker import Speaker
from .cancelling import CancelRequest
from .child import run_child
from .install_progress import shortened

_PROGRESS_INTERVAL_S = 0.1
"""A panel redraws no faster."""
_TAIL_LINES = 200


@dataclass(kw_only=True)
class Installer:
    """Runs programs in the folder that holds the environment, and speaks of what they write."""

    folder: Path
    environment: Mapping[str, str]
    request: CancelRequest
    speaking: Speaker
    stages: tuple[str, ...]
    tail: deque[str] = field(default_factory=lambda: deque(maxlen=_TAIL_LINES))
    """The last lines that a program wrote."""
    _stage: str = ""
    _said_s: float = 0.0

    def begin(self, stage: str) -> None:
        """A stage begins."""
        self.request.check()
        self._stage, self._said_s = stage, 0.0
        index = self.stages.index(stage) + 1
        self.speaking.say(protocol.Stage(name=stage, index=index, count=len(self.stages)))

    def progress(self, fraction: float, text: str) -> None:
        """How far the stage is; said no more often than is of use, but the end always is."""
        now = time.monotonic()
        if fraction < 1.0 and now - self._said_s < _PROGRESS_INTERVAL_S:
            return
        self._said_s = now
        self.speaking.say(
            protocol.Progress(stage=self._stage, fraction=fraction, text=text, remaining_s=None)
        )

    def warn(self, text: str) -> None:
        """The user should know this."""
        self.speaking.say(protocol.Warned(text=text))

    def run(
        self,
        command: Sequence[str],
        *,
        on_line: Callable[[str], None] | None = None,
        changes: Mapping[str, str] | None = None,
    ) -> bool:
        """Run the program; whether it ended well. What it wrote is in `tail`, and on stderr for the log.

        `changes` are added to the environment. Raises Cancelled.
        """
        log = sys.stderr.write

        def take(line: str) -> None:
            if not line.startswith("Progress "):  # of downloads, many a second
                log(line + "\n")
            if on_line is None:
                self.progress(0.0, shortened(line))
            else:
                on_line(line)

        return self._run(command, take, changes)

    def ask(self, command: Sequence[str]) -> bool:
        """Run the program as a question; whether it ended well. What it wrote is in `tail`, nowhere else.

        Settings may hold passwords, which no log should show. Raises Cancelled.
        """
        return self._run(command, lambda _: None, None)

    def _run(
        self, command: Sequence[str], on_line: Callable[[str], None], changes: Mapping[str, str] | None
    ) -> bool:
        self.tail.clear()

        def take(line: str) -> None:
            if not line.startswith("Progress "):
                self.tail.append(line)
            on_line(line)

        try:
            code = run_child(
                command,
                environment={**self.environment, **(changes or {})},
                folder=self.folder,
                request=self.request,
                on_line=take,
            )
        except OSError as error:  # no program of that name, or not for this computer
            self.tail.append(f"{command[0]}: {error.strerror or error}")
            return False
        return code == 0
