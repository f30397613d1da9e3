"""Tables of tensors: dataclasses whose fields all have a row for each of the same things."""

from typing import TypeVar

from jaxtyping import Bool
from torch import Tensor

Table = TypeVar("Table", bound="Rows")


class Rows:
    """What such a dataclass inherits."""

    def chosen(self: Table, which: Bool[Tensor, "rows"]) -> Table:
        """Some of them."""
        return type(self)(**{name: values[which] for name, values in vars(self).items()})
