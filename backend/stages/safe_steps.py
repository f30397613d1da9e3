"""Gradient steps that notice when a number is not finite, and go back to where all was well."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import ErrorCode, ReconstructionError

OTHER_PHOTOS = "Check that the photographs open in a viewer, or use another preset."
"""What to do where photographs teach nothing."""
PATIENCE = 5
"""Steps that may be taken back before it is better to stop: the last ones were a sixteenth as long."""


def not_finite(taken_back: int) -> str:
    """What a report says of so many steps."""
    return f"{taken_back} steps led to numbers that are not finite"


class SafeSteps:
    """Steps of an optimiser; one whose loss or gradient is not finite is taken back to the last `keep`.

    With `longest`, longer gradients are cut to that length.
    """

    def __init__(self, optimiser: torch.optim.Optimizer, *, longest: float | None = None) -> None:
        self.steps = 0
        """How many were tried."""
        self.taken_back = 0
        self._longest = longest
        self._optimiser = optimiser
        self._parameters: list[Tensor] = [p for group in optimiser.param_groups for p in group["params"]]
        self._rates: list[float] = [group["lr"] for group in optimiser.param_groups]
        self.keep()

    @property
    def hopeless(self) -> bool:
        """Whether so many steps were taken back that what they lead to is not to be trusted."""
        return self.taken_back >= PATIENCE

    @property
    def told(self) -> str:
        """What the report says of them after their number; nothing where all went well."""
        n = self.taken_back
        return f", {n} of which {'was' if n == 1 else 'were'} not finite and taken back" if n else ""

    def raise_if_nothing_was_learned(self, source: str, remedy: str) -> None:
        """ReconstructionError(NO_SURFACE) where there is no hope, or no step was a good one."""
        if self.hopeless or 0 < self.steps == self.taken_back:
            raise ReconstructionError(
                ErrorCode.NO_SURFACE,
                f"Nothing could be learned from {source}: {not_finite(self.taken_back)}.",
                remedy,
            )

    def keep(self) -> None:
        """Remember the parameters as they are."""
        self._kept = [parameter.detach().clone() for parameter in self._parameters]

    def take(self, loss: Float[Tensor, ""], length: float = 1.0) -> None:
        """One step down the loss, or back; the optimiser's memory of a bad way goes with it.

        `length` is a share of the learning rates that the optimiser had at first; each step that was taken
        back has halved it.
        """
        self.steps += 1
        for group, rate in zip(self._optimiser.param_groups, self._rates, strict=True):
            group["lr"] = rate * (length * 0.5**self.taken_back)
        self._optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        if self._longest is not None:
            torch.nn.utils.clip_grad_norm_(self._parameters, self._longest)
        gradients = [p.grad.sum() for p in self._parameters if p.grad is not None]
        if bool(torch.stack([loss.detach(), *gradients]).isfinite().all()):
            self._optimiser.step()
            return
        self.taken_back += 1
        self._optimiser.state.clear()
        with torch.no_grad():
            for parameter, kept in zip(self._parameters, self._kept, strict=True):
                parameter.copy_(kept)
