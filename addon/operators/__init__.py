"""What the buttons do: each operator reads properties, calls a function, and reports."""
