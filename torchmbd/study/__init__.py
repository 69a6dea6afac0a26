"""Studies: read from experiment files (load.py), run and tracked (run.py), reported (report.py, html_report.py).

This package imports none of its modules: `torchmbd best` and `torchmbd new` need no torch.
"""
