"""The second step of an installation: the packages, by pip, and by uv where a build of torch is chosen.

Which server has which build of torch is uv's knowledge: no address stands here. The user's settings of
pip hold, whether in variables or in files. Standard library only.
"""

import ast
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from ..errors import ErrorCode, ReconstructionError
from .install_progress import InstallProgress
from .installer import Installer

_RAW_PROGRESS = (24, 1)
"""The first pip that tells a program how far a download is."""
_BACKENDS = {"cpu": "cpu", "cuda": "auto"}
"""What uv calls the builds; auto is the one for the driver of the GPU that is found."""
_ELSEWHERE = ("PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_USER", "PIP_DRY_RUN", "PIP_REPORT", "PIP_PYTHON")
"""Settings that would lead packages to another place than the environment."""
_FOR_UV = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "cert": "SSL_CERT_FILE",
    "proxy": "HTTPS_PROXY",
    "trusted-host": "UV_INSECURE_HOST",
}
"""Settings of pip, and the variables in which uv takes the same."""
_LISTS = {"UV_INDEX": " ", "UV_FIND_LINKS": ",", "UV_INSECURE_HOST": " "}
"""Those that may be several, and what uv puts between them."""
_REASON = re.compile(
    r"\s*(?:(?:[\w.]*(?:error|exception)|caused by|cause|note):|[×├╰]"
    # for the last time: before that, an answer may have come
    r"|WARNING: Retrying (?!\(Retry\(total=[1-9]))",
    re.IGNORECASE,
)
"""Lines in which pip, an exception or uv says why it failed; the others name packages and files."""
_NETWORK = re.compile(
    r"(?<![\w/\\.-])"  # whole words, and not of a path
    r"(?:connection|name resolution|name or service not known|getaddrinfo|timed out|proxy|ssl\w*|max retries|"
    r"dns error|network|error sending request|response body|http error|http status)"
    r"\b",
    re.IGNORECASE,
)
_SHOWN_LINES = 12
_NO_SPACE_WORDS = ("no space left", "errno 28", "not enough space", "disk quota")


def pip_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment for pip: the user's, without what leads elsewhere, and without questions."""
    kept = {name: value for name, value in environment.items() if name not in (*_ELSEWHERE, "PYTHONPATH")}
    return {**kept, "PIP_USER": "0", "PIP_NO_INPUT": "1", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}


def install_packages(
    python: Path,
    requirements: Sequence[str],
    *,
    constraints: Path | None,
    build: str,
    installer: Installer,
) -> bool:
    """Install the requirements with this build of torch; whether its index could be reached.

    False only of a build that uv chooses, where uv or its index is out of reach: then "default" may do.
    Raises ReconstructionError, with the end of what pip or uv wrote, where anything else fails.
    """
    wanted = [*(("--constraint", str(constraints)) if constraints else ()), *requirements]
    pip = [str(python), "-m", "pip"]
    if build in _BACKENDS:
        if not installer.run([*pip, "install", "--progress-bar", "off", "uv"]):
            return False
        if _by_uv(python, wanted, build=build, count=len(requirements), installer=installer):
            return True
        if is_out_of_reach(installer.tail):
            return False
        raise explain(list(installer.tail))
    bar = "raw" if _has_raw_progress(pip, installer) else "off"
    command = [*pip, "install", "--progress-bar", bar, *wanted]
    if not _install(command, len(requirements), installer):
        raise explain(list(installer.tail))
    return True


def explain(tail: Sequence[str]) -> ReconstructionError:
    """Why pip failed, from the end of what it wrote."""
    said = "\n".join(tail[-_SHOWN_LINES:])
    lowered = "\n".join(tail).lower()
    if any(words in lowered for words in _NO_SPACE_WORDS):
        return ReconstructionError(
            ErrorCode.DISK_FULL, "The disk is full.", "Free some space and install again: it goes on."
        )
    if is_out_of_reach(tail):
        text = "The packages could not be fetched: the package index is out of reach."
        remedy = (
            "Check the network, and set HTTPS_PROXY or pip's own settings where a proxy is needed; "
            "then install again: what was fetched is kept."
        )
    else:
        text = "The packages could not be installed."
        remedy = "The lines above say why; with that mended, install again: what was fetched is kept."
    return ReconstructionError(ErrorCode.MISSING_DEPENDENCY, f"{text}\n{said}".rstrip(), remedy)


def is_out_of_reach(tail: Iterable[str]) -> bool:
    """Whether pip or uv failed because of the network, from the end of what it wrote."""
    return any(_NETWORK.search(line) for line in tail if _REASON.match(line))


def _by_uv(python: Path, wanted: Sequence[str], *, build: str, count: int, installer: Installer) -> bool:
    """Whether uv could install what is wanted."""
    uv = [str(python), "-m", "uv", "pip", "install", "--python", str(python)]
    command = [*uv, "--torch-backend", _BACKENDS[build], *wanted]
    return _install(command, count, installer, changes=_settings_for_uv(python, installer))


def _install(
    command: Sequence[str], count: int, installer: Installer, changes: Mapping[str, str] | None = None
) -> bool:
    reading = InstallProgress(num_requirements=count)

    def on_line(line: str) -> None:
        reading.read(line)
        installer.progress(reading.fraction, reading.text)

    return installer.run(command, on_line=on_line, changes=changes)


def _has_raw_progress(pip: Sequence[str], installer: Installer) -> bool:
    """Whether pip tells of downloads; an older one is renewed, where that is possible."""
    if _version(pip, installer) >= _RAW_PROGRESS:
        return True
    installer.run([*pip, "install", "--progress-bar", "off", "--upgrade", "pip"])
    return _version(pip, installer) >= _RAW_PROGRESS


def _version(pip: Sequence[str], installer: Installer) -> tuple[int, ...]:
    """Of pip, its first two numbers; empty where it does not tell."""
    installer.ask([*pip, "--version"])
    words = " ".join(installer.tail).split()
    numbers = words[1].split(".")[:2] if len(words) > 1 else []
    return tuple(int(number) for number in numbers if number.isdecimal())


def _settings_for_uv(python: Path, installer: Installer) -> dict[str, str]:
    """Pip's settings of package indexes, as uv takes them; uv's own settings come first."""
    installer.ask([str(python), "-m", "pip", "config", "list"])
    settings = pip_settings(installer.tail)
    found = {variable: settings[name] for name, variable in _FOR_UV.items() if name in settings}
    for name, separator in _LISTS.items():
        if name in found:
            found[name] = separator.join(found[name].split())
    return {name: value for name, value in found.items() if name not in installer.environment}


def pip_settings(lines: Sequence[str]) -> dict[str, str]:
    """Settings by name from the lines of `pip config list`; variables win over files, as in pip."""
    found: dict[str, str] = {}
    for line in sorted(lines, key=lambda line: line.startswith(":env:")):
        key, _, value = line.partition("=")
        try:
            found[key.rsplit(".", 1)[-1]] = str(ast.literal_eval(value))
        except (ValueError, SyntaxError):
            continue
    return found
