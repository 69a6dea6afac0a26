"""Other programs, and files and published numbers of others, beside ours.

Exudyn (extra `bench`)
    exudyn_peer            mechanisms of this repository in Exudyn; exudyn_beams: a rod that is an exact beam or an ANCF cable
    exudyn_comparison      equal modes, equal steps: `python -m experiments.peers.exudyn_comparison`
    closed_loops           twelve flexible links, built for both; `python -m experiments.benchmark --peer exudyn loops`
    modal_slider_crank     a rod divided into modal parts: `python -m experiments.peers.modal_slider_crank`
    soft_slider_crank      and of MuJoCo's soft rod: `python -m experiments.peers.soft_slider_crank`
MuJoCo
    mujoco_identification  a double pendulum, by its differences: `python -m experiments.peers.mujoco_identification`
Files of others, read unedited; a variable of the environment names the folder of their repository
    robots, flexible_arm   URDF, against the recursion of newton_euler; FLEXIBLE_ARM_MODELS, EXAMPLE_ROBOT_DATA
    mimic_robots           URDF with mimic joints, against MuJoCo; ROBOTIQ_85, EXAMPLE_ROBOT_DATA
    mujoco_models          MJCF, against MuJoCo; MUJOCO_MODELS
    wing_body              a Nastran model, against Simcenter Nastran and MYSTRAN; nastran_decks: all others; PYNASTRAN_MODELS
    iea_blade              windIO, against BeamDyn and ElastoDyn; IEA15_RWT
    windio_versions        windIO 1 and 2, and the tables beside them; IEA15_RWT, IEA22_RWT, and the package windIO
    shell_decks            three large Nastran models, from file to Craig-Bampton body; TACS, CRM_WING, MYSTRAN
    pazy_wing              a Nastran model, against MSC Nastran; its equivalent beam, against measurements; AEPW3_LDWG
Published numbers
    ivp_slider_crank       of the test set for IVP solvers: `python -m experiments.peers.ivp_slider_crank`
    composite_strips       measured deflections of three laminates: `python -m experiments.peers.composite_strips`

The files of others run alike, as `python -m experiments.peers.robots`; each says in its header what it needs.
"""
