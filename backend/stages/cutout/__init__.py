"""The subject cut out of photographs that came without masks."""
