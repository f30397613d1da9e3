"""Computers that there are packages for, known before anything is fetched; standard library only."""

import platform
import sys
import sysconfig

from ..errors import ErrorCode, ReconstructionError

_MACHINES = {"win32": "win-amd64", "darwin": "arm64", "linux": "x86_64"}
"""Those that each package of constraints.txt has a build for, as `_machine` names them."""
_MACOS = 14
"""The first version of macOS that torch and pycolmap have a build for."""


def check_computer() -> None:
    """ReconstructionError(MISSING_DEPENDENCY) where needed packages are not made for this computer."""
    reason = reason_against(sys.platform, _machine(), platform.mac_ver()[0])
    if reason:
        raise ReconstructionError(
            ErrorCode.MISSING_DEPENDENCY,
            f"FewView cannot be set up here: {reason}.",
            "Take Windows or Linux on an x64 processor, or a Mac with Apple silicon, macOS "
            f"{_MACOS} or later and a Blender for Apple silicon.",
        )


def reason_against(system: str, machine: str, macos: str) -> str:
    """Why there are no packages for it; empty where there are, and where nothing is known.

    `system` is a sys.platform, `macos` a version, empty elsewhere.
    """
    if machine != _MACHINES.get(system, machine):
        of = "Blenders and Macs for Intel processors" if system == "darwin" else f"the processor {machine}"
        return f"torch or pycolmap is not made for {of}"
    major = macos.partition(".")[0]
    if major.isdecimal() and int(major) < _MACOS:
        return f"torch and pycolmap are not made for macOS {macos}"
    return ""


def _machine() -> str:
    """What this Python is made for, which is not always the computer: both Windows and Macs play others."""
    return sysconfig.get_platform() if sys.platform == "win32" else platform.machine()
