"""Steps and products by C++ that is generated and compiled: a backend (integrate/backend.py).

backend.py             what it serves; library.py builds and keeps the libraries
functions.py           torch functions of the core, traced with sizes that are known at run time (symbolic.py, codegen/)
mechanism.py           counts and tables of a mechanism, by which its kind's code runs; elimination.py: of its factors
steps.py, rates.py     calls of the libraries; also backward.py, steps_of_size.py, feedback.py
compiled_products.py   products of the structure stage, written by hand
"""

from torchmbd.extensions.native.backend import NativeBackend as NativeBackend
from torchmbd.extensions.native.compiled_products import compiled_products as compiled_products

__all__: list[str] = []  # no public names: entries of registries
