"""How far an installation is, from what pip and uv write; pure, standard library only."""

import re
from dataclasses import dataclass

TEXT_LENGTH = 70
_PACKAGES_PER_REQUIREMENT = 2.1
"""About how many packages a requirement brings, itself among them; with CUDA torch brings more."""
_DOWNLOADED = 0.85
"""Share of the time that has passed when everything is there and is unpacked."""

_ASIDE = ("WARNING", "DEPRECATION", "[notice]", "Looking in")
"""What pip says beside the matter; it is in the log."""
_COLLECTING = re.compile(r"Collecting (\S+)")
_FETCHING = re.compile(r"\s*(?:Downloading|Using cached|Processing) (\S+)(.*)")
_BYTES = re.compile(r"Progress (\d+) of (\d+)")
_UV_RESOLVED = re.compile(r"Resolved (\d+) packages?")
_UV_DOWNLOADED = re.compile(r"\s*Downloaded (\S+)")
_UNPACKING = re.compile(r"Installing collected packages|Prepared \d+ packages?")
_DONE = re.compile(r"Successfully installed|Installed \d+ packages?|Audited \d+ packages?")


@dataclass(kw_only=True)
class InstallProgress:
    """Reads one line after the other; `fraction` (0 to 1) never falls."""

    num_requirements: int
    fraction: float = 0.0
    text: str = ""
    _steps: float = 0.0
    _expected: float | None = None
    _file: str = ""

    def read(self, line: str) -> None:
        """Take in a line."""
        if match := _BYTES.match(line):
            self._downloading(int(match[1]), int(match[2]))
            return
        if not line.strip() or line.startswith(_ASIDE):
            return
        self.text = shortened(line)
        if _COLLECTING.match(line) or _UV_DOWNLOADED.match(line):
            self._step()
        elif match := _FETCHING.match(line):
            self._file = match[1].rsplit("/", 1)[-1].split("-")[0]
            self._step(0.0 if match[1].endswith(".metadata") else 1.0)
        elif match := _UV_RESOLVED.match(line):
            self._expected = float(match[1])
        elif _UNPACKING.match(line):
            self._rise(_DOWNLOADED)
        elif _DONE.match(line):
            self._rise(1.0)

    def _downloading(self, done: int, size: int) -> None:
        """A part of the file that was named last; its step was counted when it began."""
        if size > 0:
            self.text = f"Downloading {self._file}: {done / 1e6:.0f} of {size / 1e6:.0f} MB"

    def _step(self, size: float = 1.0) -> None:
        self._steps += size
        # Collected and then fetched, each a step; there may be more packages than expected.
        expected = self._expected or 2 * _PACKAGES_PER_REQUIREMENT * max(self.num_requirements, 1)
        self._rise(_DOWNLOADED * self._steps / max(expected, self._steps + 2))

    def _rise(self, fraction: float) -> None:
        self.fraction = max(self.fraction, fraction)


def shortened(line: str) -> str:
    """The line without surplus spaces, cut to a length that a panel can show."""
    words = " ".join(line.split())
    return words if len(words) <= TEXT_LENGTH else words[: TEXT_LENGTH - 1] + "…"
