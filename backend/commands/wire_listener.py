"""A run as another program sees it: each event a message on the wire."""

import time
from pathlib import Path

from ..wire import protocol
from ..wire.speaker import Speaker
from ..workspace import StageCost
from .cancelling import CancelRequest

_PROGRESS_INTERVAL_S = 0.1
"""A panel redraws no faster; more lines would only fill the pipe."""


class WireListener:
    """Turns the pipeline's events into messages."""

    def __init__(self, request: CancelRequest, speaker: Speaker) -> None:
        self._request = request
        self._speaker = speaker
        self._stage = ""
        self._started_s = 0.0
        self._last_s = 0.0

    def resumed(self, stages: tuple[str, ...]) -> None:
        """Nothing: the finished stages pass by at once."""

    def stage_started(self, name: str, index: int, count: int) -> None:
        """Send Stage."""
        self._stage, self._started_s, self._last_s = name, time.monotonic(), 0.0
        self._speaker.say(protocol.Stage(name=name, index=index, count=count))

    def progressed(self, fraction: float, text: str) -> None:
        """Send Progress, though not too often; raises Cancelled if the caller asked to stop."""
        self._request.check()
        now = time.monotonic()
        if now - self._last_s >= _PROGRESS_INTERVAL_S:
            self._last_s = now
            self._say_progress(fraction, text)

    def stage_finished(self, cost: StageCost) -> None:
        """Send the full Progress."""
        self._say_progress(1.0, f"{cost.seconds:.1f} s")

    def previewed(self, path: Path) -> None:
        """Send Preview."""
        self._speaker.say(protocol.Preview(path=str(path)))

    def warned(self, text: str) -> None:
        """Send Warned."""
        self._speaker.say(protocol.Warned(text=text))

    def _say_progress(self, fraction: float, text: str) -> None:
        fraction = min(max(float(fraction), 0.0), 1.0)
        elapsed_s = time.monotonic() - self._started_s
        remaining_s = elapsed_s * (1.0 - fraction) / fraction if fraction > 0.0 else None
        self._speaker.say(
            protocol.Progress(stage=self._stage, fraction=fraction, text=text, remaining_s=remaining_s)
        )
