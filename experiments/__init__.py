"""Models, the tables and figures of the paper, comparisons with other programs, and benchmarks.

models        slider_crank, sar_antenna (with sar_antenna_*), two_link_arm, spatial_arm, panel, steered_rod, tutorial/
paper/        `python -m experiments.paper`: table3, table4, table5, figures4_7, figures8_11, minima, ...
others        exudyn_*, mujoco_models, robots, flexible_arm, nastran_decks, wing_body, iea_blade, *_slider_crank
benchmark/    `python -m experiments.benchmark`; benchmark_elements, benchmark_modes, benchmark_tracking
pages         validation writes docs/validation; gallery/ and documentation/ make pictures, notebooks, links
"""
