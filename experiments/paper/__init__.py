"""The paper again: every table and figure that has numbers, beside ours. `python -m experiments.paper --list`

all in one report          `python -m experiments.paper`, or some parts: `python -m experiments.paper table2 figures4_7`
                           rod, antenna, antenna_deployed hold the parts; part, parts, report run and print them
the slider-crank           table3, table4, table5, figures4_7, figures8_11: `python -m experiments.paper.table3`
   its optima otherwise    minima (64 starts), enumeration and discrete (increments of 5 degrees), pareto, robust:
                           `python -m experiments.paper.robust --samples 64`
   its numbers elsewhere   reference (energies of two independent codes), gradients (against differences):
                           `python -m experiments.paper.reference --cells 12x2`
the antenna                antenna_tables (first phase), antenna_optimum (Tables 7, 8), antenna_geometry (how far its chosen
                           geometry matters): `python -m experiments.paper.antenna_tables describe`

The models are torchmbd.examples.slider_crank and experiments/models/sar_antenna*.py.
"""
