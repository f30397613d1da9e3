"""The smallest network of ONNX that stands in for one that cuts out: how bright each pixel is.

Written as the bytes of its protobuf messages (onnx.proto), for the package that makes such files is large.
"""

_FLOAT, _INTS = 1, 7
"""ONNX's numbers of the type of a tensor, and of an attribute."""


def brightness_network(side_px: int = 1024) -> bytes:
    """From a batch of one picture, channels first, the mean over the channels."""
    axes = _text(1, "axes") + _number(8, 1) + _number(20, _INTS)
    keep = _text(1, "keepdims") + _number(3, 1) + _number(20, 2)
    node = _text(1, "picture") + _text(2, "shares") + _text(4, "ReduceMean")
    node += _message(5, axes) + _message(5, keep)
    graph = _message(1, node) + _text(2, "brightness")
    graph += _message(11, _tensor("picture", (1, 3, side_px, side_px)))
    graph += _message(12, _tensor("shares", (1, 1, side_px, side_px)))
    return _number(1, 8) + _message(7, graph) + _message(8, _number(2, 13))


def _tensor(name: str, shape: tuple[int, ...]) -> bytes:
    sizes = b"".join(_message(1, _number(1, size)) for size in shape)
    return _text(1, name) + _message(2, _message(1, _number(1, _FLOAT) + _message(2, sizes)))


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _text(field: int, value: str) -> bytes:
    return _message(field, value.encode())


def _message(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    groups = []
    while value > 127:
        groups.append(value & 127 | 128)
        value >>= 7
    return bytes([*groups, value])
