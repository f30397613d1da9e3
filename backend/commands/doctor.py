"""The command that checks the environment, for a program on the wire; standard library only."""

from ..doctor import Check, examine, is_ready, not_ready
from ..wire import protocol
from ..wire.speaker import Speaker
from .cancelling import CancelRequest, catch_signals
from .reconstruct import converse, say_last

_CANCELLED = protocol.Failed(
    code=protocol.CANCELLED, text="The check was stopped.", remedy="Check again when you like."
)


def doctor_on_wire() -> int:
    """Say each check as it is made, then whether a reconstruction can start here; the exit code."""
    return converse(_check, _CANCELLED)


def _check(request: CancelRequest, speaking: Speaker) -> None:
    made: list[Check] = []
    for check in examine():
        catch_signals()  # an import may have taken them
        made.append(check)
        speaking.say(protocol.Checked(name=check.name, fine=check.fine, found=check.found))
        request.check()
    if not is_ready(made):
        raise not_ready(made)
    say_last(speaking, protocol.Finished(output="", files=()))
