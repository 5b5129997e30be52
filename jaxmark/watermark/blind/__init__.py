"""Blind marks, which are read without the original, from the key and the suspect alone."""
