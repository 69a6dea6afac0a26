"""What docs/ has that is computed. docs/develop.md builds the site.

generated, reference, blocks, hooks    parts of pages that come from the program, blocks of code, equations
validation, recorded                   pages of docs/validation: `python -m experiments.documentation.validation --list`
pictures, animated_svg                 docs/images: `python -m experiments.documentation.pictures falling_arm`
notebooks                              tutorials as notebooks: `python -m experiments.documentation.notebooks`
code                                   counts and drawing of docs/read_the_code.md: `python -m experiments.documentation.code`
path                                   files and functions of one iteration: `python -m experiments.documentation.path`
links                                  follows all links of the built site: `python -m experiments.documentation.links site`
"""
