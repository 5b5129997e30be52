"""Keyed signs and permutations, and codes: from messages to code bits and back.

Everything runs on the host, and its results never change, so that old marks stay readable.
"""
