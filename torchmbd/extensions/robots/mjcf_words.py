"""Words of MJCF files: elements below the root, and attributes that are read or do not change the motion of rigid bodies.

The latter belong to the solver, to contact (which is left out as a whole), to pictures and to groups. Source:
mujoco.readthedocs.io, XML reference. Checked in tests/extensions/robots/test_mjcf.py.
"""

from __future__ import annotations

SECTIONS = (
    *("compiler", "option", "default", "worldbody", "equality", "actuator", "tendon", "contact", "deformable", "asset"),
    *("custom", "extension", "keyframe", "sensor", "size", "statistic", "visual"),
)
_POSE = "pos quat axisangle xyaxes zaxis euler"
_SOLVER = "solref solimp solreflimit solimplimit solreffriction solimpfriction"
_ACTUATOR = (
    "name class group user joint jointinparent tendon site refsite cranksite slidersite body gear ctrlrange ctrllimited "
    "forcerange forcelimited gaintype biastype dyntype gainprm biasprm dynprm kp kv timeconst dampratio lengthrange "
    "cranklength actdim actearly actlimited actrange"
)
ATTRIBUTES = {
    "compiler": "alignfree angle assetdir autolimits balanceinertia boundinertia boundmass conflict coordinate discardvisual "
    "eulerseq fitaabb fusestatic inertiafromgeom inertiagrouprange meshdir passthrough savecanonical savecompiled "
    "saveinertial settotalmass strippath texturedir usethread exactmeshinertia",
    "option": "apirate ccd_iterations ccd_tolerance cone density gravity impratio integrator iterations jacobian "
    "ls_iterations ls_tolerance magnetic mpr_iterations mpr_tolerance noslip_iterations noslip_tolerance o_friction o_margin "
    "o_solimp o_solref sdf_initpoints sdf_iterations sleep_tolerance solver timestep tolerance viscosity wind",
    "body": f"name childclass {_POSE} gravcomp mocap sleep user",
    "frame": f"name childclass {_POSE}",
    "inertial": f"mass diaginertia fullinertia {_POSE}",
    "freejoint": "name group align",
    # of bodies, of connections, of tendons
    "joint": f"name class type group pos axis springdamper limited actuatorfrclimited range actuatorfrcrange stiffness "
    f"springref ref damping armature frictionloss margin actuatorgravcomp user {_SOLVER} active joint1 joint2 polycoef "
    "joint coef",
    "connect": f"name class active body1 body2 anchor site1 site2 {_SOLVER}",
    "weld": f"name class active body1 body2 anchor relpose site1 site2 torquescale {_SOLVER}",
    "motor": _ACTUATOR,
    "position": _ACTUATOR,
    "velocity": _ACTUATOR,
    "general": _ACTUATOR,
    # of bodies, of tendons
    "geom": f"name class type size fromto mass density group contype conaffinity shellinertia mesh {_POSE} adhesion "
    f"castshadow condim fitscale fluidcoef fluidshape friction gap hfield margin material priority rgba solmix surfacevel "
    f"user {_SOLVER} geom sidesite",
}
KNOWN = {tag: frozenset(words.split()) for tag, words in ATTRIBUTES.items()}
