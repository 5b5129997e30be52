"""The one compiled module, for which jax has the headers."""

import jax.ffi
from setuptools import Extension, setup

setup(
    ext_modules=[
        Extension(
            "jaxmark_kernels._targets",
            ["jaxmark_kernels/module.cc"],
            depends=["jaxmark_kernels/recurrence.h", "jaxmark_kernels/crew.h"],
            include_dirs=[jax.ffi.include_dir()],
            extra_compile_args=["-std=c++17", "-O3", "-w"],
            language="c++",
            py_limited_api=True,
        )
    ],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
