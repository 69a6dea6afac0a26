"""Mechanisms and structures: `build()` of a module returns a System; a class or a table holds the data of a family.

sar_antenna            half of the antenna of the paper, first phase; its parts in sar_antenna_bodies, its data in
                       sar_antenna_data, both phases in sar_antenna_whole, its gaps in sar_antenna_clearance, the
                       flatness of its panels in the sun in sar_antenna_flatness
spatial_arm            two laminated tubes under gravity, asked about in configs/spatial_arm
arm_twin               an arm identified from its own motion, with noise: `python -m experiments.models.arm_twin 100`
turning_blade          a blade on a hub, asked about in configs/turning_blade
pendulum_rig           a rig whose friction and inertia are measured, asked about in configs/pendulum_rig
steered_rod            fibers that steer: `python -m experiments.models.steered_rod`, 45 minutes
large_shells           a plate and a wing box of many freedoms: `python -m experiments.benchmark large`
panel                  a laminated panel on three joints
parts                  eight ordinary parts, each with an experiment file: docs/validation/parts.md; part_optima: their optima
                       by closed forms and scans
five_bar               a pick-and-place robot: `python -m experiments.benchmark chosen-steps`
chain, delta_robot, falling_arm, flapping_blade, four_bar, spacecraft
                       mechanisms of docs/gallery.md: `python -m experiments.documentation.pictures four_bar` draws the motion
                       that `motion()` returns
shell_problems         published problems of plates and shells: `python -m experiments.benchmark.elements published`
eigen_families         K(b), M(b) whose modes are known exactly: `python -m experiments.models.eigen_families`

The slider-crank of the paper and the two-link arm, which tests use everywhere, are in torchmbd.examples.
"""
