"""C++ code with loops from torch functions: sizes and index tables are known when the code runs, not when it is compiled.

size.py      sizes and indices: polynomials of sizes that are known at run time
program.py   operations on numbers that depend on loop variables, and writes to buffers
array.py     tensors whose axes may be loops, with which torch functions are traced
reverse.py   derivatives of a program in reverse mode
schedule.py  the loops of a function, and their order
emit.py      C++
"""

from torchmbd.extensions.native.codegen import operators as operators
