"""jaxmark: differentiable spectral filtering of polygonal meshes, and the watermarking built on it.

What is listed in `__init__.pyi` is imported when it is first used, so that a room comes alone: `import
jaxmark.spectral` loads filters and nothing of the watermark.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
