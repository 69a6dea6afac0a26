"""What docs/ has that is computed. docs/develop.md builds the site.

hooks, reference, blocks, docstrings   parts of pages that mkdocs and the tests put in: tables, blocks of code, signatures
validation, recorded                   pages of docs/validation: `python -m experiments.documentation.validation --list`
pictures, animated_svg                 docs/images: `python -m experiments.documentation.pictures falling_arm`
notebooks                              tutorials as notebooks: `python -m experiments.documentation.notebooks`
code                                   counts and drawing of docs/read_the_code.md: `python -m experiments.documentation.code`
path                                   files and functions of one iteration: `python -m experiments.documentation.path`
links                                  follows all links of the built site: `python -m experiments.documentation.links site`
"""
