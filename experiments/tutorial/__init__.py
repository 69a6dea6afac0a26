"""Programs of docs/tutorials, printed there and run by the tests.

arm, overshoot.yaml   a robot arm and its experiment: `torchmbd check experiments/tutorial/overshoot.yaml`
codesign              laminate and controller trained together, some minutes: `python -m experiments.tutorial.codesign`
"""
