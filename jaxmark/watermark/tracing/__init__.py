"""Fingerprinted copies for recipients: collusion-resistant codes, and the identification of leaked copies."""
