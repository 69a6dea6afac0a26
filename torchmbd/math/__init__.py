"""Value-tangent pairs, time jets and rotations: the arithmetic in which the motion is written."""
