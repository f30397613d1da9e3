"""reconstruct."""

CLASSES = ()
