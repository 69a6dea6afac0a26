"""Experiments: a file in (load.py), a tracked study out (run.py). Modules are imported by name, each by who needs it:
`torchmbd best` and `torchmbd new` do without torch.
"""
