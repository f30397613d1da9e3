"""The command that makes the managed environment: a Python with all that the backend needs.

It speaks the wire and needs the standard library alone, so that Blender's own Python can run it. What is
begun lies in DIR.part; it becomes DIR when `doctor` has said "ready" of it, and not before. A stopped
installation goes on where it was: the packages that pip has fetched are in its cache.
"""

import hashlib
import os
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from ..doctor import DEPENDENCIES
from ..errors import ErrorCode, ReconstructionError
from ..version import VERSION
from ..wire import protocol
from ..wire.client import ROOT, clean_environment
from ..wire.environment import BUILDS, CONSTRAINTS, PART, RECORD, beside, python_in, requirements
from ..wire.speaker import Speaker
from . import environment_folder as folders
from .cancelling import CancelRequest
from .child import run_child
from .computers import check_computer
from .installer import Installer
from .packages import install_packages, pip_environment
from .reconstruct import converse, say_last
from .virtual_environment import make_environment, works

_STAGES = ("python", "packages", "check")
_CANCELLED = protocol.Failed(
    code=protocol.CANCELLED,
    text="The installation was stopped; what was fetched is kept.",
    remedy="Install again to go on.",
)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is to be made, and where."""

    folder: Path
    build: str = "default"
    """One of wire.environment.BUILDS."""
    again: bool = False
    """Whether an environment that is ready is made anew."""
    requirements_file: Path | None = None
    """Requirements, one a line, in place of those of pyproject.toml."""

    def __post_init__(self) -> None:
        if self.build not in BUILDS:
            raise ValueError(f"unknown build {self.build!r}; known: {', '.join(BUILDS)}")


def install(plan: Plan) -> int:
    """Make the environment, with messages on stdout; the exit code."""
    whole = replace(plan, folder=plan.folder.absolute())
    return converse(lambda request, speaking: _install(whole, request, speaking), _CANCELLED)


def remove(folder: Path) -> int:
    """Remove an environment that `install` made, with messages on stdout; the exit code."""
    return converse(lambda _, speaking: _remove(folder.absolute(), speaking), _CANCELLED)


def _remove(folder: Path, speaking: Speaker) -> None:
    with folders.held(folder):
        warning = folders.take_away(folder)
    if warning:
        speaking.say(protocol.Warned(text=warning))
    say_last(speaking, protocol.Finished(output="", files=()))


def _install(plan: Plan, request: CancelRequest, speaking: Speaker) -> None:
    with folders.held(plan.folder):
        installer = Installer(
            folder=plan.folder.parent,
            environment=pip_environment(clean_environment(os.environ)),
            request=request,
            speaking=speaking,
            stages=_STAGES,
        )
        if plan.again or not _is_ready(plan, installer):
            if plan.requirements_file is None:
                check_computer()
            folders.check_length(plan.folder)
            folders.check_space(plan.folder, plan.build)
            _make(plan, installer)
    say_last(speaking, protocol.Finished(output=str(plan.folder), files=()))


def _is_ready(plan: Plan, installer: Installer) -> bool:
    """Whether there is an environment already that passes the check; a warning says that it stays."""
    if not python_in(plan.folder).is_file():
        return False
    installer.begin("check")
    try:
        _check(plan.folder, installer)
    except ReconstructionError:
        return False
    known = folders.read_json(plan.folder / RECORD)
    build = known.get("torch_build") if isinstance(known, dict) else None
    which = "" if build == plan.build else f", with the build {build} of torch"
    installer.warn(f"The environment in {plan.folder} is ready{which}; it stays. Make it anew to change it.")
    return True


def _make(plan: Plan, installer: Installer) -> None:
    """Make DIR.part, check it, rename it; one that was begun before and then fails is made anew."""
    part = beside(plan.folder, PART)
    wanted, note = _wanted(plan), begun_for(plan)
    is_continued = folders.begin_part(part, note)
    try:
        build, checks = _fill(plan, wanted, installer)
    except ReconstructionError as error:
        if not is_continued or error.code is not ErrorCode.MISSING_DEPENDENCY:
            raise
        folders.remove(part)
        folders.begin_part(part, note)
        build, checks = _fill(plan, wanted, installer)
    made = {"torch_build": build, "fewview": VERSION, "made": datetime.now(UTC).isoformat(timespec="seconds")}
    versions = {check.name: check.found for check in checks}
    folders.write_json(part / RECORD, {**note, **made, "found": versions})
    if warning := folders.put_in_place(part, plan.folder):
        installer.warn(warning)


def begun_for(plan: Plan) -> dict[str, object]:
    """What tells one plan's beginning from another's; a beginning is continued for the same alone."""
    constraints = ROOT / CONSTRAINTS
    pinned = constraints.read_text(encoding="utf-8") if constraints.is_file() else ""
    asked_for = "\0".join((*_wanted(plan), pinned))
    return {
        "program": "fewview",
        "torch_build": plan.build,
        "requirements_sha256": hashlib.sha256(asked_for.encode()).hexdigest(),
    }


def _fill(plan: Plan, wanted: tuple[str, ...], installer: Installer) -> tuple[str, list[protocol.Checked]]:
    """The three steps, in DIR.part; the build of torch that came, and what the check found."""
    part = beside(plan.folder, PART)
    installer.begin("python")
    if not works(part, installer):
        make_environment(part, installer)
    installer.begin("packages")
    build = _install_packages(plan, wanted, installer)
    installer.begin("check")
    checks = _check(part, installer)
    gpu = next((check for check in checks if check.name == "cuda"), None)
    if build == "cuda" and (gpu is None or not gpu.fine):
        why = f"The GPU cannot be used ({gpu.found})" if gpu else "No GPU by NVIDIA was found"
        installer.warn(f"{why}: this environment computes on the processor.")
    return build, checks


def _install_packages(plan: Plan, wanted: tuple[str, ...], installer: Installer) -> str:
    """The second step; the build of torch that there is now, "default" where the other cannot be fetched."""
    constraints = ROOT / CONSTRAINTS
    install_with = partial(
        install_packages,
        python_in(beside(plan.folder, PART)),
        wanted,
        constraints=constraints if constraints.is_file() else None,
        installer=installer,
    )
    if install_with(build=plan.build):
        return plan.build
    installer.warn(
        f"The {plan.build.upper()} build of torch could not be chosen, because uv or its package index is "
        "out of reach; the usual build of the package index is installed."
    )
    folders.check_space(plan.folder, "default")
    install_with(build="default")
    return "default"


def _check(folder: Path, installer: Installer) -> list[protocol.Checked]:
    """What `doctor` finds in the environment. Raises ReconstructionError unless that is "ready"."""
    checks: list[protocol.Checked] = []
    last: list[protocol.Message] = []

    def on_line(line: str) -> None:
        try:
            message = protocol.decode(line)
        except protocol.ProtocolError:
            return  # it then has no last word, which is a failure
        if isinstance(message, protocol.Checked):
            checks.append(message)
            installer.progress(min(len(checks) / len(DEPENDENCIES), 1.0), f"{message.name} {message.found}")
        elif isinstance(message, protocol.Finished | protocol.Failed):
            last.append(message)

    run_child(
        [str(python_in(folder)), "-m", "backend", "doctor", "--wire"],
        environment=clean_environment(os.environ),
        folder=folder.parent,
        request=installer.request,
        on_line=on_line,
        errors_too=False,
    )
    if last and isinstance(last[0], protocol.Finished):
        for check in checks:  # now, because only what the environment in use has is of interest
            installer.speaking.say(check)
        return checks
    said = last[0].text if last and isinstance(last[0], protocol.Failed) else "The check gave no answer."
    raise ReconstructionError(
        ErrorCode.MISSING_DEPENDENCY,
        f"The environment cannot be used. {said}",
        "Show Log has the details; please report it if installing again does not help.",
    )


def _wanted(plan: Plan) -> tuple[str, ...]:
    if plan.requirements_file is None:
        return requirements(ROOT)
    lines = plan.requirements_file.read_text(encoding="utf-8").splitlines()
    return tuple(line.strip() for line in lines if line.strip())
