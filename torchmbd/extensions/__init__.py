"""Extensions: what torchmbd can do beside its core, each a package or a file here, which may be taken away.

They use the core by its registries and public contracts; the core imports none of them. torchmbd/registry.py finds what the
tables below name, at the first look-up. To add an extension: its package or file, whose `__all__` are its public names; a line
in NAMES; an import for type checkers; and entries of registries, if it has some (docs/how-to/extend.md).
Checked in tests/test_registry.py, tests/test_layers.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # type checkers find `mbd.rainflow` by these
    from torchmbd.extensions.beamdyn import *  # noqa: F403
    from torchmbd.extensions.buckling import *  # noqa: F403
    from torchmbd.extensions.fatigue import *  # noqa: F403
    from torchmbd.extensions.fibers import *  # noqa: F403
    from torchmbd.extensions.identification import *  # noqa: F403
    from torchmbd.extensions.lamination import *  # noqa: F403
    from torchmbd.extensions.matrices import *  # noqa: F403
    from torchmbd.extensions.meshes import *  # noqa: F403
    from torchmbd.extensions.nastran import *  # noqa: F403
    from torchmbd.extensions.native import *  # noqa: F403
    from torchmbd.extensions.openmdao import *  # noqa: F403
    from torchmbd.extensions.paraview import *  # noqa: F403
    from torchmbd.extensions.ply_book import *  # noqa: F403
    from torchmbd.extensions.robots import *  # noqa: F403
    from torchmbd.extensions.shell_models import *  # noqa: F403
    from torchmbd.extensions.vibrations import *  # noqa: F403
    from torchmbd.extensions.windio import *  # noqa: F403

#: Extension, or a module in it, -> its public names, `mbd.<name>`; `viz.` before those of pictures.
NAMES = {
    "beamdyn": "read_beamdyn",
    "buckling": "Buckling BucklingFactor BucklingIndex buckling",
    "fatigue": "Damage EquivalentLoad FatigueDamage SNCurve rainflow",
    "fibers": "FiberCurvature FiberDivergence FiberField SteeredLaminate viz.fiber_paths",
    "identification": "Channel Experiment FrequencyResponseData Identification ModalData StaticCurve TimeSeries identify "
    "viz.data_and_model",
    "lamination": "LaminationParameters LaminationRegion LaminationRules recover_blended_stacks recover_stacks",
    "matrices": "read_matrix",
    "meshes": "read_mesh",
    "nastran": "read_bdf write_bdf",
    "native": "",
    "openmdao": "openmdao_component",
    "paraview": "viz.save_mesh viz.save_modes viz.save_motion",
    "ply_book": "write_ply_book",
    "robots": "read_mjcf read_urdf",
    "shell_models": "write_model",
    "vibrations": "Campbell CampbellClearance CriticalSpeed DampingRatio FrequencyResponse LinearSystem StabilityLimit"
    " StabilityMargin SystemFrequency campbell frozen_poles linearize",
    "vibrations.pictures": "viz.animate_mode viz.campbell viz.mode_motion viz.root_locus",
    "windio": "read_windio",
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
