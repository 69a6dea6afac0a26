"""Native code with loops out of torch functions: sizes and index tables are known when it runs, not when it is compiled.

size.py      sizes and indices: polynomials of sizes that are known at run time
program.py   operations on numbers that depend on loop variables, and what is stored in buffers
array.py     tensors whose axes may be loops: what torch functions are traced with
reverse.py   derivatives of a program in reverse mode
schedule.py  which loops a function is made of, and what they share
emit.py      C++
"""

from torchmbd.math.codegen import operators as operators
