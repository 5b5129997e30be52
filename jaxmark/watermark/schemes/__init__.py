"""Schemes, which fix everything about a mark except its key, message and strength."""
