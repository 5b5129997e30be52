"""Copies for recipients: fingerprints that resist collusion, and whom a suspect accuses."""
