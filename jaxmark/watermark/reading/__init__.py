"""Reading of aligned suspects: reception without the key, detectors of bits, and the reading of coarse suspects."""
