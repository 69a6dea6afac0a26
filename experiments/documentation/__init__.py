"""What the documentation has that is made by programs: reference pages, tables of the paper, figures."""
