"""What torchmbd was tried on. The docstring of each folder says what is in it and how to run it.

models         mechanisms and structures; the slider-crank and the two-link arm are in torchmbd.examples
paper          tables and figures of the paper, beside ours: `python -m experiments.paper`
peers          other programs, and files and published numbers of others, beside ours
benchmark      times, memory, accuracy: `python -m experiments.benchmark`
tutorial       the programs of docs/tutorials
documentation  what docs/ has that is computed: pictures, tables, notebooks, the pages of docs/validation

A folder imports those above it in the order models, peers, paper, benchmark, tutorial, documentation; no module imports
itself through others. Checked in tests/experiments/test_imports.py.
"""
