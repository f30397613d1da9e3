"""Tables of tensors: choosing rows, and putting tables together."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from backend.maths.rows import Rows, together


@dataclass(frozen=True, kw_only=True)
class Table(Rows):
    number: Int64[Tensor, "rows"]
    place: Float[Tensor, "rows 3"]


def test_tables_chosen_apart_and_put_together_are_the_same_rows() -> None:
    number = torch.arange(5)
    whole = Table(number=number, place=torch.randn(5, 3))
    apart = [whole.chosen(number < 2), whole.chosen(number == 9), whole.chosen(number >= 2)]
    assert [len(part.number) for part in apart] == [2, 0, 3]
    torch.testing.assert_close(vars(together(apart)), vars(whole), rtol=0, atol=0)
