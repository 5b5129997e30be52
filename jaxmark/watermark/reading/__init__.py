"""From what a suspect shows to soft decisions and claims: reception without the key, detectors, coarse suspects."""
