"""cameras."""

CLASSES = ()
