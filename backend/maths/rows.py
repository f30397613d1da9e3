"""Tables of tensors: dataclasses whose fields all have a row for each of the same things."""

from collections.abc import Sequence
from typing import TypeVar

import torch
from jaxtyping import Bool
from torch import Tensor

Table = TypeVar("Table", bound="Rows")


class Rows:
    """What such a dataclass inherits."""

    def chosen(self: Table, which: Bool[Tensor, "rows"]) -> Table:
        """Some of them."""
        return type(self)(**{name: values[which] for name, values in vars(self).items()})


def together(tables: Sequence[Table]) -> Table:
    """The rows of all tables, of which there is at least one."""
    return type(tables[0])(
        **{name: torch.cat([vars(table)[name] for table in tables]) for name in vars(tables[0])}
    )
