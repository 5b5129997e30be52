"""Keyed signs and permutations, and the code that maps messages to code bits and back.

Everything runs on the host. The results never change between versions, so that old marks stay readable.
"""
