"""jaxmark: differentiable spectral filtering of polygonal meshes, and watermarking based on it.

The names in `__init__.pyi` are imported when they are first used, so that subpackages load separately: `import
jaxmark.spectral` loads the filters, but no watermarking.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
