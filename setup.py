"""The compiled kernel: optional, installation succeeds without a compiler too. All else: pyproject.toml."""

import hashlib
from pathlib import Path

from setuptools import Extension, setup

FOLDER = Path("fieldcal/compiled")
sources, headers = (sorted(path.as_posix() for path in FOLDER.glob(kind)) for kind in ("*.c", "*.h"))
# The same digest as `fieldcal.compiled.source_digest`: a kernel that was compiled from another source is not used.
digest = hashlib.sha256(b"".join(Path(name).read_bytes() for name in sorted([*sources, *headers]))).hexdigest()[:12]

setup(
    ext_modules=[
        # A plain shared library, loaded by ctypes: it needs neither Python's nor NumPy's headers.
        Extension(
            "fieldcal.compiled._kernel",
            sources,
            depends=headers,
            define_macros=[("FIELDCAL_SOURCE", f'"{digest}"')],
            extra_compile_args=["-O3", "-fno-math-errno"],
            libraries=["m"],
            optional=True,
        )
    ]
)
