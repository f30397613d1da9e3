"""The program's version; pyproject.toml and blender_manifest.toml say the same, and a test compares them."""

VERSION = "0.1.0"
