"""Scan registration: bones, weights and motions of an articulated thing without a template.

Besides the public names, pictures may use `PoseSolver`, `BoneTree`, `blend_linear` and `check_rigid_motions`, and
commands `RegisterRecord` and `RobotModel`, and the search for poses `ScanTokens`, `match_probabilities` and
`shared_matcher`.
"""
