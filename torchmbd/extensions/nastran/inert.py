"""Cards that carry neither mass nor stiffness nor support: these alone may be left out of a body.

Loads, analyses, sets, tables, aerodynamics, optimization, plots, dampers (a body has damping of its modes), materials and
properties that no element names. Every other card that is not read is refused: an unknown one may be structure.
Source: MSC Nastran Quick Reference Guide, section 8; Simcenter Nastran Quick Reference Guide, section 16.
Checked in tests/extensions/nastran/test_refusal.py.
"""

from __future__ import annotations

import re

#: Left out without a word: they say nothing about the structure.
QUIET = ("EIGRL", "EIGR", "PLOTEL", "MDLPRM", "ECHOON", "ECHOOFF")
_KINDS = (
    # loads, temperatures, enforced motions, heat flow
    r"FORCE([12]|AX)?|MOMENT[12]?|PLOAD\w*|PRESAX|GRAV|ACCEL1?|RFORCE[12D]?|LOAD|LOADCY[NHT]|LSEQ|SLOAD|CLOAD|DEFORM|SPC[DR]",
    r"TEMP(D|P[123]|RB|AX|F|BC|N1|G|B3|EX)?|DAREA|DELAY|DPHASE|DLOAD|RLOAD[12]|TLOAD[12]|TICD?|ACSRCE|Q(VECT|VOL|BDY[1-4]|HBDY)",
    r"RANDPS|RANDT[12]|RANDVAR|UNBALNC|BOLT(FOR|LD|SEQ)?",
    # analyses, sets of freedoms, free bodies
    r"EIG[BCPR]|EIGRL|FREQ[1-6]?|TSTEP\w*|NL(PARM|PCI|STEP\w*|ADAPT|CNTL\w*|MOPTS|AUTO|OUT)|AUTOSPC|MDLPRM|ECHO(ON|OFF)|ITER|SPCOFF1?",
    r"[ABCQ]SET1?|OMIT1?|USET1?|BND(FIX1?|FREE|FRE1)|SET[1-4]|SUPORT[16]?|SEQ[GE]P|SPOINT|EPOINT|DTI|DMI|DMI[JKL]I?|DEQATN|LABEL",
    # tables; systems, which are refused where something refers to them
    r"TAB\w+|DTABLE\w*|CORD[123]\w+",
    # aerodynamics
    r"AE\w+|AERO[SZ]?|CAERO[1-57]|SPLINE[1-7]|SPLIN(EX|RB)|MKAERO[12Z]|FL(FACT|UTTER)|GUST|TRIM\w*|DIVERG|CSSCHD|UXVEC",
    r"MON(PNT[123]|DSP1|GRP|SUM\w*|CNCM)|ACCSSPT",
    # optimization
    r"DESVAR|DV([CMPG]REL[12]|GRID|GEOM|BSHAP|SHAP|PSURF|LREL1|TREL1)|DCON(STR|ADD)|DRESP[123]|DLINK|DOPTPRM|DSCREEN|DDVAL",
    r"BEADVAR|TO[PM]VAR|MODTRAK|BNDGRID|BLDOUT",
    # pictures, names, places of results
    r"PLOT\w+|POINT|SNORM|ABSNMVS|CBARAO",
    # dampers
    r"CDAMP[1-5]|CVISC|DAMPING|HYBDAM[CP]",
    # no element without them, or with another number: what is named and not read is refused by the element
    r"P(COMPS|BCOMP|BEAM3|BEND|BEMN1|BARN1|BMSECT|BRSECT|BUSH(T|1D|2D)|COMPF|COMPLS|CONEAX|CONV|CONVM|DAMP[5T]?|ELAST|FAST|GAP|LPLANE)",
    r"P(LSOLID|MASS|RODN1|SEAM|SHLN[12]|SLDN1|SOLIDL|VISC|WELD|AERO[1-57]|ANEL|SET|VAL|AABSF|ACABS|ACBAR|HBDY|DUM\d)",
    r"MAT(S\d|S\w+|[4567]|11|CRP|F|F1|FT|G|HE|HEM|HP|HP1|NLE\d?|ORT|PLCY|SMA|TC|UDS|UDMR|UDST|VE|VP|EP|FC)",
    # heat
    r"CHBDY[EGP]|CONVM?|RADBC|RADBND|RADCAV|RADLST|RADM|RADMT|RADMTX|RADSET|VIEW(3D|EX)?|BDYOR|THPAD|TEMPEX",
)
_INERT = re.compile("|".join(f"(?:{kind})" for kind in _KINDS))


def is_inert(name: str) -> bool:
    """True if a card is known to carry neither mass nor stiffness nor support."""
    return _INERT.fullmatch(name) is not None
