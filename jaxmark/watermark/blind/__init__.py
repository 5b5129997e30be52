"""Marks that are read without the original: by the key and the suspect alone."""
