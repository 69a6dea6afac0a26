"""The paper again: every table and figure that has numbers, beside ours. `python -m experiments.paper`"""
