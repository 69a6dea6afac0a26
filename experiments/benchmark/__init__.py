"""torchmbd and a peer side by side: `python -m experiments.benchmark [parts...]`; __main__.py lists the parts."""
