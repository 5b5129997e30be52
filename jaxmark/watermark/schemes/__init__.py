"""Schemes, which determine everything about a mark except its key, message and strength."""
