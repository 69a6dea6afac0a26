"""Studies: experiment files (file/), runs on disk and in the tracking store (record/), tables, pictures and reports (report/).

The modules here compute: settings.py holds a study, run.py runs it, front.py and sweep.py are its two other forms.
This package imports none of its modules: `torchmbd best` and `torchmbd new` need no torch.
"""
