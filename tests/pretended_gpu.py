"""A GPU that is not there: tensors in the CPU's memory that claim to be on one, with a GPU's refusals.

What fails on a GPU alone would be found on no machine without one. Here these fail as there: tensors of two
devices in one operation, numpy on what is there, matrix products of whole numbers (CUDA's refusal), and
numbers of double precision (that of Apple's GPUs).
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

GPU = torch.device("mps", 0)
"""Not "cuda": what is there for CUDA alone, such as graphs, needs a GPU."""
_ON_GPU: Mapping[str, object] = {"device": GPU, "is_mps": True, "is_cpu": False}
_CLAIM = "claims_to_be_on_a_gpu"
_MATRIX_PRODUCTS = frozenset({"addmm", "addmv", "bmm", "dot", "einsum", "matmul", "mm", "mv"})
_MAY_MIX = frozenset({"__getitem__", "__setitem__", "copy_", "new_tensor", "to"})
_FROM_CPU = frozenset({"tensor", "from_numpy"})
_TO_NUMPY = frozenset({"__array__", "numpy"})


class RefusedError(RuntimeError):
    """What a GPU would not have done."""


class PretendedGpu(TorchFunctionMode):
    """Within it, what is asked for on `GPU` is made, and claims to be there."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """One operation of torch, or one attribute of a tensor."""
        given = dict(kwargs or {})
        if func is torch.device:
            return func(*args, **given)
        # an attribute is read by the __get__ of what describes it
        name = func.__self__.__name__ if func.__name__ == "__get__" else func.__name__  # type: ignore[attr-defined]
        if name in _ON_GPU and claims(args[0]):
            return _ON_GPU[name]
        tensors = list(_tensors([*args, *given.values()]))
        _refuse(name, tensors)
        there = _ends_there(name, args, given)
        result = func(*_on_cpu(args), **_on_cpu(given))
        return _claiming(result, there, {_memory(tensor) for tensor in tensors})


def claims(tensor: Tensor) -> bool:
    """Whether it claims to be on the GPU: then all that share its memory do."""
    return getattr(tensor.untyped_storage(), _CLAIM, False)


def _refuse(name: str, tensors: list[Tensor]) -> None:
    if not any(map(claims, tensors)):
        return
    if name in _TO_NUMPY:
        raise RefusedError("numpy does not read what is on a GPU")
    if name in _MATRIX_PRODUCTS and not tensors[0].is_floating_point():
        raise RefusedError(f"{name} of whole numbers is not implemented on a GPU")
    # a single number may come from anywhere
    if name not in _MAY_MIX and not all(claims(tensor) for tensor in tensors if tensor.dim()):
        raise RefusedError(f"{name} got tensors of two devices")


def _ends_there(name: str, args: tuple[Any, ...], given: Mapping[str, Any]) -> bool:
    """Whether the result is on the GPU: where it is asked for, else where what it is made from is."""
    wanted = args[1] if name == "to" and len(args) > 1 else given.get("device")
    if isinstance(wanted, Tensor):
        return claims(wanted)
    if isinstance(wanted, str | torch.device):
        return torch.device(wanted).type == GPU.type
    made_from = [*args, *given.values()] if name != "__setitem__" else args[:1]
    return name not in _FROM_CPU and name != "cpu" and any(map(claims, _tensors(made_from)))


def _on_cpu(value: Any) -> Any:
    """The same arguments, with the CPU in the GPU's place."""
    if isinstance(value, torch.device):
        return torch.device("cpu")
    if isinstance(value, str) and value.partition(":")[0] == GPU.type:
        return "cpu"
    if type(value) is dict:
        return {key: _on_cpu(part) for key, part in value.items()}
    return type(value)(_on_cpu(part) for part in value) if type(value) in (tuple, list) else value


def _claiming(result: Any, there: bool, before: set[int]) -> Any:
    """The result where it belongs; a copy if it would lie in the memory `before` it, which is elsewhere."""
    if isinstance(result, Tensor):
        if there and result.dtype == torch.float64:
            raise RefusedError("Apple's GPUs have no double precision")
        if claims(result) != there:
            result = result.clone() if _memory(result) in before else result
            setattr(result.untyped_storage(), _CLAIM, there)
        return result
    if isinstance(result, tuple | list):
        return type(result)([_claiming(part, there, before) for part in result])
    return result


def _memory(tensor: Tensor) -> int:
    return tensor.untyped_storage()._cdata


def _tensors(values: Any) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, tuple | list):
            yield from _tensors(value)
