"""Extensions: what torchmbd can do beside its core, each a package or a file here, which may be taken away.

They use the core by its registries and public contracts; the core imports none of them. torchmbd/registry.py finds what the
tables below name, at the first look-up. To add an extension: its package or file, whose `__all__` are its public names; a line
in NAMES; an import for type checkers, here or in torchmbd/io.py; entries of registries, if it has some
(docs/how-to/extend.md).
Checked in tests/test_registry.py, tests/test_layers.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # type checkers find `mbd.fatigue.rainflow` by these
    from torchmbd.extensions import buckling as buckling
    from torchmbd.extensions import fatigue as fatigue
    from torchmbd.extensions import fibers as fibers
    from torchmbd.extensions import identification as identification
    from torchmbd.extensions import lamination as lamination
    from torchmbd.extensions import vibrations as vibrations
    from torchmbd.extensions.openmdao import *  # noqa: F403

#: Extension, or a module in it, -> its public names, `mbd.<name>`. Before the name stands its room: the extension itself, `io`
#: (torchmbd/io.py) for readers and writers of files, or `viz` for pictures.
NAMES = {
    "beamdyn": "io.read_beamdyn",
    "buckling": "buckling.BucklingFactor buckling.BucklingIndex buckling.BucklingModes buckling.linear_buckling",
    "fatigue": "fatigue.Damage fatigue.EquivalentLoad fatigue.FatigueDamage fatigue.SNCurve fatigue.rainflow",
    "fibers": "fibers.FiberCurvature fibers.FiberDivergence fibers.FiberField fibers.SteeredLaminate viz.fiber_paths",
    "identification": "identification.Channel identification.Experiment identification.FrequencyResponseData "
    "identification.Identification identification.ModalData identification.StaticCurve identification.TimeSeries "
    "identification.identify viz.data_and_model",
    "lamination": "lamination.LaminationParameters lamination.LaminationRegion lamination.LaminationRules "
    "lamination.recover_blended_stacks lamination.recover_stacks",
    "matrices": "io.read_matrix",
    "meshes": "io.read_mesh",
    "nastran": "io.read_bdf io.write_bdf",
    "native": "",
    "openmdao": "openmdao_component",
    "paraview": "viz.save_mesh viz.save_modes viz.save_motion",
    "ply_book": "io.write_ply_book",
    "robots": "io.read_mjcf io.read_urdf",
    "shell_models": "io.write_model",
    "vibrations": "vibrations.CampbellClearance vibrations.CampbellDiagram vibrations.CriticalSpeed vibrations.DampingRatio "
    "vibrations.FrequencyResponse vibrations.LinearSystem vibrations.StabilityLimit vibrations.StabilityMargin "
    "vibrations.SystemFrequency vibrations.campbell vibrations.frozen_poles vibrations.linearize",
    "vibrations.pictures": "viz.animate_mode viz.campbell viz.mode_motion viz.root_locus",
    "windio": "io.read_windio",
}
#: Extension -> those that it imports: without them it is not there either.
NEEDS = {
    "identification": ("vibrations",),
    "lamination": ("fibers",),
    "matrices": ("nastran",),
    "meshes": ("nastran",),
    "shell_models": ("nastran",),
}
#: Registry (Registry(name, ...) in the core: responses, backends, kinds of experiment files, ...) -> name -> "module:object".
ENTRIES: dict[str, dict[str, str]] = {
    "backends": {"native": "native:NativeBackend"},
    "products": {"native": "native:compiled_products"},
    "responses": {"buckling_index": "buckling:BucklingIndex"},
    "combinators": {"equivalent_load": "fatigue:EquivalentLoad"},
    "of_design": {
        "buckling_factor": "buckling:BucklingFactor",
        "fatigue_damage": "fatigue:FatigueDamage",
        "fiber_curvature": "fibers:FiberCurvature",
        "fiber_divergence": "fibers:FiberDivergence",
        "lamination_region": "lamination:LaminationRegion",
        "system_frequency": "vibrations:SystemFrequency",
        "damping_ratio": "vibrations:DampingRatio",
        "stability_margin": "vibrations:StabilityMargin",
        "critical_speed": "vibrations:CriticalSpeed",
        "campbell_clearance": "vibrations:CampbellClearance",
        "stability_limit": "vibrations:StabilityLimit",
        "frequency_response": "vibrations:FrequencyResponse",
    },
    "of_equilibrium": {
        "eigenvalues": "vibrations.eigenvalues:eigenvalues",
        "damping_ratios": "vibrations.spectrum:damping_ratios",
    },
    "drawings": {"vibrations": "vibrations.pictures.vibration_pictures:draw_vibrations"},
    "experiments": {"identify": "identification:IDENTIFY"},
}
