"""When a fit asks what brightness tells, and how it goes by the answer."""

from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from ...scene import Decision, Progress
from ..deadline import Deadline
from ..measurements import Measurements
from .linear_fit import Ask, LinearConfig, for_plain, for_textured, weight_beside
from .shared_brightness import MOSTLY_TEXTURED, ShownPlaces, share_told, shared_brightness, textured

_LITTLE = 0.1
"""Weight of what brightness tells, beside stereo's points: with less, asking again moves nothing."""


@dataclass(kw_only=True)
class Looks:
    """Those of one fit, grid by grid."""

    scene: Measurements
    linear: LinearConfig
    deadline: Deadline
    seconds: float = 0.0
    """That they took."""
    shares: list[float] = field(default_factory=list)
    """Of the surface that is textured, before each grid on which brightness might be asked."""
    shown: list[ShownPlaces] = field(default_factory=list)
    """What was told at each."""

    @property
    def told(self) -> ShownPlaces | None:
        """At the last look; None if nothing."""
        return self.shown[-1] if self.shown and len(self.shown[-1].weights) else None

    @property
    def _mostly_textured(self) -> bool:
        return bool(self.shares) and self.shares[-1] > MOSTLY_TEXTURED

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """What was made of texture, and what brightness was worth."""
        if not self.shares:
            return (self.of_brightness,)
        linear = for_textured(self.linear) if self._mostly_textured else self.linear
        doubt = Decision(
            what="doubtful points",
            choice=f"weigh as their confidence to the power of {linear.confidence_power:g}",
            because=f"patches tell {self.shares[-1]:.0%} of the surface",
        )
        return (doubt, self.of_brightness)

    @property
    def of_brightness(self) -> Decision:
        """What brightness was worth, for the report."""
        what, count = "brightness without texture", max((len(s.weights) for s in self.shown), default=0)
        if count:
            because = f"the same from two sides, it tells the depth of {count} places that no texture tells"
            if (most := max(float(s.mirrored.max()) for s in self.shown if len(s.mirrored))) > 0:
                because += f"; it shines, and what it mirrors, up to {most:.1%} of white, is taken off"
        elif self.shown:
            because = "what patches agree on is not equally bright, or too little to tell"
        elif self._mostly_textured:
            because = f"patches tell {self.shares[-1]:.0%} of the surface"
        else:
            because = "not asked for, or time ran out before it"
        return Decision(what=what, choice="used" if count else "left out", because=because)

    def planned(
        self, before: Float[Tensor, "nodes nodes nodes"], wanted: int, *, is_last: bool
    ) -> tuple[LinearConfig, int]:
        """How a grid is fitted that begins with the field `before`, and how many of `wanted` looks it has.

        None if most of the surface is textured. What was told on the grid before leads the last one.
        """
        if not wanted:
            return self.linear, 0
        self.shares.append(textured(self.scene, before))
        if self._mostly_textured:
            return for_textured(self.linear), 0
        linear = self.linear
        if self.told is not None and is_last:
            linear = for_plain(linear, self.shares[-1], share_told(self.told, before))
        return linear, wanted if self.linear.brightness else 0

    def on_grid(self, wanted: int, progress: Progress) -> Ask:
        """Asks up to `wanted` times while there is time.

        Once if that weighs little: beside texture it does not, and each look takes as long as a round.
        """
        before, began_s = len(self.shown), self.deadline.clock()

        def ask(distance: Float[Tensor, "nodes nodes nodes"]) -> ShownPlaces | None:
            if len(self.shown) > before and weight_beside(self.shown[-1], self.scene, self.linear) < _LITTLE:
                return None
            # a look and a round take less than the fit did until here
            asked_s = self.deadline.clock()
            if self.deadline.left_s() < asked_s - began_s:
                return None
            progress((len(self.shown) - before) / wanted, "looking where photographs are equally bright")
            self.shown.append(shared_brightness(self.scene, distance, may_shine=self.linear.may_shine))
            self.seconds += self.deadline.clock() - asked_s
            return self.told

        return ask
