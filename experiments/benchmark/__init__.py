"""Times, memory and accuracy, beside a peer where there is one. `python -m experiments.benchmark [parts...]`

__main__   lists the parts and runs them; a part is a function (settings) -> Result in the file of its name:
           `python -m experiments.benchmark --quick pendulum`
parts      motion, chains, beams, load_cases, multistart, study, evaluate, batches, adjoint, angles, segments, stiffening,
           integrators, errors, campbell, chosen_steps, costs, methods, cores, couplings, large, tube
cases      the mechanisms; report: what a part returns; processes: fresh processes
elements   accuracy of elements, large meshes: `python -m experiments.benchmark.elements bending`
modes      modes and their derivatives: `python -m experiments.benchmark.modes --no-large`
tracking   the experiment layer and its workers: `python -m experiments.benchmark.tracking start`
stages     where the time of a command goes: `python -m experiments.benchmark.stages list configs`
"""
